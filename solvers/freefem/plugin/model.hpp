// What is modelled: mesh, materials, loaded faces, prestrain, system.
#ifndef LACLI_MODEL_HPP
#define LACLI_MODEL_HPP
#include "prestrain.hpp"
#include "system.hpp"

namespace lacli {

struct Faces {
  Surface kind;
  std::vector<int> nodes;                    // 6 (or 3) per triangle
  std::vector<double> weight;                // per triangle and point
  std::vector<double> slope;                 // of the weights along the pericardium's threshold; empty: not told
  std::vector<int> blocks;                   // lower-triangular pairs of each triangle
};

struct Model {
  int nU = 0, nP = 0, nt = 0, nn = 0;
  TetRule rule;
  TriRule face;
  std::vector<int> nodes, pressures;         // per cell: nn nodes, 4 pressure unknowns
  std::vector<int> blocks;                   // per cell: nn (nn + 1) / 2
  std::vector<CellData> cells;
  std::vector<int> regions;                  // per cell: 0 to 4 of the body, else -1; empty: not told
  std::vector<double> fibres;                // per cell and point, on the parameter cell
  std::vector<Faces> faces;
  std::vector<double> stretch;               // per cell and point: stretch before the reference (9); empty: none
  std::vector<double> anchor;                // where springs are at rest (x | y | z); empty: in the reference X
  std::vector<double> rest;                  // where springs are at rest whatever the prestrain (x | y | z); empty: X - v
  double viscosity = 0;                      // kPa/mm2
  double loads[4] = {0, 0, 0, 0};            // by Surface
  System system;
  Mumps mumps;
  int ordering = 7;
  double minJ = 0, minJX = 0, energy = 0, volume = 0;
  int negative = 0;
};

inline std::vector<int> ints(const KN<long> &a) {
  std::vector<int> r(a.N());
  for (long i = 0; i < a.N(); ++i) r[i] = (int)a[i];
  return r;
}

}  // namespace lacli
#endif
