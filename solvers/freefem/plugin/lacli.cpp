// FreeFEM plugin: assembles residual and tangent of the wall and its boundary, factorises and solves.
// The script owns the loads, the steps and the decisions; this file owns the loops over cells.
// link: -ldmumps_seq -lmpiseq_seq
#include <cstdint>
#include <iostream>
#include <limits>

#include "ff++.hpp"
#include "AFunction_ext.hpp"

#include "model.hpp"
#include "sensitivities.hpp"

using namespace lacli;

namespace {

Model *the = nullptr;

// of an array that may be empty, whose entry 0 is nothing that one may refer to
template <class T> T *first(KN<T> &a) { return a; }

// laMesh([nU, nP, cells, nodes per cell, points, ordering], nodes of cells, pressure unknowns of cells)
long laMesh(KN<long> *const &sizes, KN<long> *const &nodes, KN<long> *const &pressures) {
  delete the;
  the = new Model;
  Model &P = *the;
  P.nU = (int)(*sizes)[0], P.nP = (int)(*sizes)[1], P.nt = (int)(*sizes)[2], P.nn = (int)(*sizes)[3];
  P.ordering = (int)(*sizes)[5];
  P.rule = tet_rule(P.nn, (int)(*sizes)[4]);
  P.face = tri_rule(P.nn == 10 ? 6 : 3);
  P.nodes = ints(*nodes), P.pressures = ints(*pressures);
  ffassert((int)P.nodes.size() == P.nt * P.nn && (int)P.pressures.size() == P.nt * 4);
  std::vector<int> pressureOf(P.nU, -1);
  for (int k = 0; k < P.nt; ++k)
    for (int c = 0; c < 4; ++c) pressureOf[P.nodes[k * P.nn + c]] = P.pressures[4 * k + c];
  std::vector<uint64_t> keys;
  keys.reserve((size_t)P.nt * P.nn * (P.nn + 1) / 2);
  for (int k = 0; k < P.nt; ++k)
    for (int a = 0; a < P.nn; ++a)
      for (int b = 0; b <= a; ++b) {
        const uint64_t i = P.nodes[k * P.nn + a], j = P.nodes[k * P.nn + b];
        keys.push_back(i >= j ? i << 32 | j : j << 32 | i);
      }
  P.system.pattern(P.nU, P.nP, pressureOf, keys);
  P.blocks.reserve((size_t)P.nt * P.nn * (P.nn + 1) / 2);
  for (int k = 0; k < P.nt; ++k)
    for (int a = 0; a < P.nn; ++a)
      for (int b = 0; b <= a; ++b) {
        const int i = P.nodes[k * P.nn + a], j = P.nodes[k * P.nn + b];
        P.blocks.push_back(P.system.block(std::max(i, j), std::min(i, j)));
      }
  return P.system.n;
}

// columns of the table of cells; lacli/mechanics/inputs.py writes them
enum CellColumn { LAW, STIFFNESS, EXPONENT, CONSTANTS, KAPPA_POINTS = CONSTANTS + 3, KAPPA_FIELD, FIBRE, STABILISATION = FIBRE + 3,
                  CELL_COLUMNS };

Material material_of(const double *v) {
  return {(int)v[LAW], v[STIFFNESS], v[EXPONENT], {v[CONSTANTS], v[CONSTANTS + 1], v[CONSTANTS + 2]}, v[KAPPA_POINTS], v[KAPPA_FIELD]};
}

// laCells(per cell: CellColumn; X of the image)
long laCells(KN<double> *const &table, KN<double> *const &image) {
  Model &P = *the;
  ffassert(table->N() == (long)P.nt * CELL_COLUMNS && image->N() == 3L * P.nU);
  P.cells.resize(P.nt);
  P.fibres.assign((size_t)P.nt * P.rule.n * 3, 0.0);
  for (int k = 0; k < P.nt; ++k) {
    double v[CELL_COLUMNS];
    for (int j = 0; j < CELL_COLUMNS; ++j) v[j] = (*table)[(long)k * CELL_COLUMNS + j];
    P.cells[k] = {material_of(v), v[STABILISATION]};
    for (int q = 0; q < P.rule.n; ++q) {
      const double *dN = &P.rule.dN[(size_t)q * P.nn * 3];
      Mat H = {}, Hi;
      for (int a = 0; a < P.nn; ++a)
        for (int i = 0; i < 3; ++i)
          for (int m = 0; m < 3; ++m) H[i][m] += (*image)[(long)i * P.nU + P.nodes[k * P.nn + a]] * dN[3 * a + m];
      const double d = det(H);
      if (!(d > 0)) return k + 1;            // the image's own cell is inverted
      inverse(H, d, Hi);
      for (int i = 0; i < 3; ++i)
        P.fibres[((size_t)k * P.rule.n + q) * 3 + i] = Hi[i][0] * v[FIBRE] + Hi[i][1] * v[FIBRE + 1] + Hi[i][2] * v[FIBRE + 2];
    }
  }
  return 0;
}

// laRest(x): springs are at rest in x, for the prestrain problem from now on, for others from the next laPrestrain; empty: in X - v
long laRest(KN<double> *const &x) {
  Model &P = *the;
  ffassert(x->N() == 0 || x->N() == 3L * P.nU);
  P.rest.assign(first(*x), first(*x) + x->N());
  return 0;
}

// laPrestrain(v, X): the stretch exp(sym grad v) on the reference X from now on, springs at rest in X - v or where laRest put them;
// empty v: none
long laPrestrain(KN<double> *const &v, KN<double> *const &reference) {
  Model &P = *the;
  P.stretch.clear(), P.anchor.clear();
  if (v->N() == 0) return 0;
  ffassert(v->N() == 3L * P.nU);
  P.anchor.resize(3 * P.nU);
  for (long i = 0; i < v->N(); ++i) P.anchor[i] = P.rest.empty() ? (*reference)[i] - (*v)[i] : P.rest[i];
  P.stretch.resize((size_t)P.nt * P.rule.n * 9);
  double X[10][3], d[10][3];
  for (int k = 0; k < P.nt; ++k) {
    for (int a = 0; a < P.nn; ++a)
      for (int i = 0; i < 3; ++i) {
        const long at = (long)i * P.nU + P.nodes[k * P.nn + a];
        X[a][i] = (*reference)[at], d[a][i] = (*v)[at];
      }
    prestretch(P.rule, X, d, &P.stretch[(size_t)k * P.rule.n * 9]);
  }
  return 0;
}

// laViscosity(kPa/mm2): damps the steps of the next tangents
long laViscosity(double const &viscosity) {
  the->viscosity = viscosity;
  return 0;
}

// laFaces(kind, nodes of triangles, weights at their quadrature points)
long laFaces(long const &kind, KN<long> *const &nodes, KN<double> *const &weight) {
  Model &P = *the;
  Faces f;
  f.kind = (Surface)kind, f.nodes = ints(*nodes);
  f.weight.resize(weight->N());
  for (long i = 0; i < weight->N(); ++i) f.weight[i] = (*weight)[i];
  const int m = P.face.nodes;
  ffassert(f.nodes.size() / m == f.weight.size() / P.face.n);
  for (size_t k = 0; k < f.nodes.size() / m; ++k)
    for (int a = 0; a < m; ++a)
      for (int b = 0; b <= a; ++b) {
        const int i = f.nodes[k * m + a], j = f.nodes[k * m + b];
        const int at = P.system.block(std::max(i, j), std::min(i, j));
        if (at < 0) return (long)k + 1;      // not a face of any cell
        f.blocks.push_back(at);
      }
  P.faces.push_back(f);
  return 0;
}

// laFixed(per unknown: 1 held, 0 free)
long laFixed(KN<long> *const &flags) {
  for (int i = 0; i < the->system.n; ++i) the->system.fixed[i] = (char)((*flags)[i] != 0);
  return 0;
}

// laLoads(pressure kPa, vein springs kPa/mm, pericardium kPa/mm)
long laLoads(double const &pressure, double const &veins, double const &pericardium) {
  the->loads[PRESSURE] = pressure, the->loads[VEIN_SPRING] = veins;
  the->loads[PERICARDIUM] = the->loads[PERICARDIUM_OUTWARD] = pericardium;
  return 0;
}

template <int STRIDE>
void scatter(System &s, int block, int na, int nb, const double *K, int la, int lb, bool sym) {
  // local nodes la, lb stand at na, nb; the block's rows belong to the larger node
  const bool turned = na < nb;
  const int a = turned ? nb : na, b = turned ? na : nb, ka = turned ? lb : la, kb = turned ? la : lb;
  const int width = STRIDE == LOCAL ? 4 : 3, lda = STRIDE;
  const int wa = std::min(width, s.width(a)), wb = std::min(width, s.width(b)), stride = s.width(b);
  double *lo = &s.lower[s.start[block]], *up = sym ? nullptr : &s.upper[s.start[block]];
  for (int i = 0; i < wa; ++i)
    for (int j = 0; j < wb; ++j) {
      lo[i * stride + j] += K[(width * ka + i) * lda + width * kb + j];
      if (!sym && a != b) up[i * stride + j] += K[(width * kb + j) * lda + width * ka + i];
    }
}

// what laAssemble makes (names.idp has the same): the residual, or it and the symmetric, the unsymmetric, the inverse problem's
// tangent; of the prestrain problem, where y = (v | p) and X is the image, the residual, or it and its tangent (not symmetric)
enum Asked { RESIDUAL, SYMMETRIC, UNSYMMETRIC, INVERSE, PRESTRAIN_RESIDUAL, PRESTRAIN };

// laAssemble(asked, y, X, R):
// y = (x | y | z | p) deformed positions and pressures, X = (X | Y | Z). 0, or 1 where a cell is inverted or too far strained.
long laAssemble(long const &asked, KN<double> *const &y, KN<double> *const &reference, KN<double> *const &residual) {
  Model &P = *the;
  System &s = P.system;
  const bool pre = asked == PRESTRAIN_RESIDUAL || asked == PRESTRAIN, sym = asked == SYMMETRIC;
  const Task task = asked == RESIDUAL || asked == PRESTRAIN_RESIDUAL ? Task::residual
                    : asked == INVERSE || asked == PRESTRAIN         ? Task::inverse
                                                                     : Task::forward;
  const double *anchor = P.anchor.empty() ? first(*reference) : P.anchor.data();
  if (task != Task::residual) s.clear(sym);
  KN<double> &R = *residual;
  R = 0.0;
  P.minJ = P.minJX = 1e300, P.energy = P.volume = 0;
  static CellSums c;
  const int nn = P.nn, nb = nn * (nn + 1) / 2;
  double X[10][3], x[10][3], p[4];
  for (int k = 0; k < P.nt; ++k) {
    const int *node = &P.nodes[k * nn];
    for (int a = 0; a < nn; ++a)
      for (int i = 0; i < 3; ++i) {
        X[a][i] = (*reference)[(long)i * P.nU + node[a]];
        x[a][i] = (*y)[(long)i * P.nU + node[a]];
      }
    for (int i = 0; i < 4; ++i) p[i] = (*y)[3L * P.nU + P.pressures[4 * k + i]];
    const double *fibres = &P.fibres[(size_t)k * P.rule.n * 3];
    const double *stretch = P.stretch.empty() ? nullptr : &P.stretch[(size_t)k * P.rule.n * 9];
    const bool fine = pre ? prestrain_integral(P.rule, P.cells[k], X, x, p, fibres, P.viscosity, asked == PRESTRAIN, c)
                          : cell_integral(P.rule, P.cells[k], X, x, p, fibres, stretch, P.viscosity, task, c);
    P.minJ = std::min(P.minJ, c.minJ), P.minJX = std::min(P.minJX, c.minJX);
    if (!fine) return 1;
    P.energy += c.energy;
    for (int a = 0; a < nn; ++a)
      for (int i = 0; i < 3; ++i) R[(long)i * P.nU + node[a]] += c.R[4 * a + i];
    for (int i = 0; i < 4; ++i) R[3L * P.nU + P.pressures[4 * k + i]] += c.R[4 * i + 3];
    if (task == Task::residual) continue;
    const int *block = &P.blocks[(size_t)k * nb];
    for (int a = 0; a < nn; ++a)
      for (int b = 0; b <= a; ++b) scatter<LOCAL>(s, *block++, node[a], node[b], &c.K[0][0], a, b, sym);
  }
  static FaceSums f;
  const int m = P.face.nodes;
  for (const Faces &set : P.faces) {
    const double value = P.loads[set.kind];
    for (size_t k = 0; k < set.nodes.size() / m; ++k) {
      const int *node = &set.nodes[k * m];
      for (int a = 0; a < m; ++a)
        for (int i = 0; i < 3; ++i) {
          const long at = (long)i * P.nU + node[a];
          x[a][i] = pre ? (*reference)[at] : (*y)[at];
          X[a][i] = !pre ? anchor[at] : P.rest.empty() ? x[a][i] - (*y)[at] : P.rest[at];
        }
      face_integral(P.face, set.kind, value, &set.weight[k * P.face.n], X, x, task, f);
      P.energy += f.energy, P.volume += f.volume;
      for (int a = 0; a < m; ++a)
        for (int i = 0; i < 3; ++i) R[(long)i * P.nU + node[a]] += f.R[3 * a + i];
      if (task == Task::residual || (set.kind == PRESSURE && task == Task::inverse)) continue;
      if (pre && !P.rest.empty()) continue;  // the force does not depend on v
      for (int i = 0; i < 3 * m && pre; ++i)
        for (int j = 0; j < 3 * m; ++j) f.K[i][j] = -f.K[i][j];  // X = image - v
      if (sym)                               // over a closed or rim-fixed cavity the halves that do not match cancel
        for (int i = 0; i < 3 * m; ++i)
          for (int j = 0; j < i; ++j) f.K[i][j] = f.K[j][i] = 0.5 * (f.K[i][j] + f.K[j][i]);
      const int *block = &set.blocks[k * m * (m + 1) / 2];
      for (int a = 0; a < m; ++a)
        for (int b = 0; b <= a; ++b) scatter<18>(s, *block++, node[a], node[b], &f.K[0][0], a, b, sym);
    }
  }
  for (long i = 0; i < R.N(); ++i)
    if (!std::isfinite(R[i])) return 1;
  return 0;
}

// laFactor(): 0, or MUMPS's error number
long laFactor() {
  Model &P = *the;
  return P.mumps.factor(P.system, P.ordering, P.negative);
}

// laSolve(b, x): K x = b on the free unknowns with the last factors, x = 0 on the held ones
long laSolve(KN<double> *const &b, KN<double> *const &x) {
  Model &P = *the;
  const long error = P.mumps.solve(P.system, first(*b), first(*x));
  for (int i = 0; i < P.system.n; ++i)
    if (P.system.fixed[i]) (*x)[i] = 0.0;
    else if (!std::isfinite((*x)[i])) return -99;
  return error;
}

// laMultiply(v, y): y = K v with the last tangent, held unknowns included
long laMultiply(KN<double> *const &v, KN<double> *const &y) {
  the->system.multiply(first(*v), first(*y));
  return 0;
}

// what laState tells, in this order (names.idp has the same): least J and det X, energy kPa mm3, cavity volume mm3, negative pivots
enum Told { MIN_J, MIN_JX, ENERGY, VOLUME, NEGATIVE, TOLD };

// laState(Told)
long laState(KN<double> *const &out) {
  Model &P = *the;
  const double v[TOLD] = {P.minJ, P.minJX, P.energy, P.volume, (double)P.negative};
  for (int i = 0; i < TOLD && i < out->N(); ++i) (*out)[i] = v[i];
  return 0;
}

// laInputs(region of each cell: 0 to 4, else -1; derivatives of the pericardium's weights along its threshold): what laSlopes
// wants to know beside the problem. 0, or 1 where there are not as many weights as the pericardium has.
long laInputs(KN<long> *const &regions, KN<double> *const &slopeOfWeights) {
  Model &P = *the;
  P.regions = ints(*regions);
  ffassert((int)P.regions.size() == P.nt);
  long bad = 0;
  for (Faces &set : P.faces)
    if (set.kind == PERICARDIUM || set.kind == PERICARDIUM_OUTWARD) {
      if (slopeOfWeights->N() != (long)set.weight.size()) bad = 1;
      else set.slope.assign(first(*slopeOfWeights), first(*slopeOfWeights) + slopeOfWeights->N());
    }
  return bad;
}

// laSlopes(y, X, rates of the prestrain's v (empty: none), pressure's derivatives along EDP and ESP, out): derivatives of
// laAssemble's residual along all inputs, one column after the other. 0, or 1 as laAssemble.
long laSlopes(KN<double> *const &y, KN<double> *const &reference, KN<double> *const &rates, KN<double> *const &shares,
              KN<double> *const &out) {
  const long n = (long)INPUTS * the->system.n;
  ffassert(out->N() == n && shares->N() == 2 && (rates->N() == 0 || rates->N() == n) && !the->regions.empty());
  return slopes(*the, first(*y), first(*reference), rates->N() ? first(*rates) : nullptr, first(*shares), first(*out));
}

// laSolveAll(b, z): K z = b for all inputs' columns with the last factors
long laSolveAll(KN<double> *const &b, KN<double> *const &z) {
  ffassert(b->N() == (long)INPUTS * the->system.n && z->N() == b->N());
  return solve_all(*the, first(*b), first(*z));
}

// laWriteRates(file, node of each unknown, columns of all inputs): 0, or 1 where it cannot be written
long laWriteRates(string *const &file, KN<long> *const &order, KN<double> *const &rates) {
  ffassert(order->N() == the->nU && rates->N() == (long)INPUTS * the->system.n);
  return write_rates(*the, file->c_str(), *order, first(*rates));
}

// laKeep(file, unknowns, their columns of all inputs), laRead(file, array of the length wanted): 0, or 1
long laKeep(string *const &file, KN<double> *const &z, KN<double> *const &rates) { return write_numbers(file->c_str(), *z, *rates); }
long laRead(string *const &file, KN<double> *const &a) { return read_numbers(file->c_str(), *a); }

// laLaw(CellColumn without the last; (F row by row, p); out: W, P (9), A (81), dP/df (27)): 0 or 1
long laLaw(KN<double> *const &material, KN<double> *const &state, KN<double> *const &out) {
  ffassert(material->N() == STABILISATION);
  double v[STABILISATION];
  for (int j = 0; j < STABILISATION; ++j) v[j] = (*material)[j];
  const Material m = material_of(v);
  Mat F;
  for (int i = 0; i < 9; ++i) F[i / 3][i % 3] = (*state)[i];
  const double f[3] = {v[FIBRE], v[FIBRE + 1], v[FIBRE + 2]};
  Response r;
  if (!respond(m, F, f, (*state)[9], 2, r)) return 1;
  KN<double> &o = *out;
  o.resize(1 + 9 + 81 + 27);
  o[0] = r.energy;
  for (int i = 0; i < 9; ++i) {
    o[1 + i] = r.P[i / 3][i % 3];
    for (int j = 0; j < 9; ++j) o[10 + 9 * i + j] = r.A[i][j];
    for (int j = 0; j < 3; ++j) o[91 + 3 * i + j] = r.dPdf[i][j];
  }
  return 0;
}

}  // namespace

static void Load_Init() {
  int argc = 0;
  char **argv = nullptr;
  MPI_Init(&argc, &argv);
  Global.Add("laMesh", "(", new OneOperator3_<long, KN<long> *, KN<long> *, KN<long> *>(laMesh));
  Global.Add("laCells", "(", new OneOperator2_<long, KN<double> *, KN<double> *>(laCells));
  Global.Add("laPrestrain", "(", new OneOperator2_<long, KN<double> *, KN<double> *>(laPrestrain));
  Global.Add("laRest", "(", new OneOperator1_<long, KN<double> *>(laRest));
  Global.Add("laViscosity", "(", new OneOperator1_<long, double>(laViscosity));
  Global.Add("laFaces", "(", new OneOperator3_<long, long, KN<long> *, KN<double> *>(laFaces));
  Global.Add("laFixed", "(", new OneOperator1_<long, KN<long> *>(laFixed));
  Global.Add("laLoads", "(", new OneOperator3_<long, double, double, double>(laLoads));
  Global.Add("laAssemble", "(", new OneOperator4_<long, long, KN<double> *, KN<double> *, KN<double> *>(laAssemble));
  Global.Add("laFactor", "(", new OneOperator0<long>(laFactor));
  Global.Add("laSolve", "(", new OneOperator2_<long, KN<double> *, KN<double> *>(laSolve));
  Global.Add("laMultiply", "(", new OneOperator2_<long, KN<double> *, KN<double> *>(laMultiply));
  Global.Add("laState", "(", new OneOperator1_<long, KN<double> *>(laState));
  Global.Add("laInputs", "(", new OneOperator2_<long, KN<long> *, KN<double> *>(laInputs));
  Global.Add("laSlopes", "(",
             new OneOperator5_<long, KN<double> *, KN<double> *, KN<double> *, KN<double> *, KN<double> *>(laSlopes));
  Global.Add("laSolveAll", "(", new OneOperator2_<long, KN<double> *, KN<double> *>(laSolveAll));
  Global.Add("laWriteRates", "(", new OneOperator3_<long, string *, KN<long> *, KN<double> *>(laWriteRates));
  Global.Add("laKeep", "(", new OneOperator3_<long, string *, KN<double> *, KN<double> *>(laKeep));
  Global.Add("laRead", "(", new OneOperator2_<long, string *, KN<double> *>(laRead));
  Global.Add("laLaw", "(", new OneOperator3_<long, KN<double> *, KN<double> *, KN<double> *>(laLaw));
}
LOADFUNC(Load_Init)
