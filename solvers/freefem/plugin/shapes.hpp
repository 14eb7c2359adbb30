// Lagrange shape functions and quadrature on the reference tetrahedron and triangle.
// Nodes in FreeFEM's order: vertices, then the middles of edges (01 02 03 12 13 23), on triangles (12 20 01).
#ifndef LACLI_SHAPES_HPP
#define LACLI_SHAPES_HPP
#include <vector>

namespace lacli {

struct TetRule {
  int n;                                     // points
  int nodes;                                 // 4 or 10
  std::vector<double> w, N, L, dN;           // weights (sum 1/6), nodes' and vertices' values, [q][a][3] gradients
};

struct TriRule {
  int n, nodes;                              // nodes 3 or 6
  std::vector<double> w, N, d1, d2;          // weights (sum 1/2), values, derivatives along the edges 01, 02
};

inline void tet_shapes(int nodes, const double b[4], double *N, double *dN) {
  static const double dB[4][3] = {{-1, -1, -1}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  static const int edge[6][2] = {{0, 1}, {0, 2}, {0, 3}, {1, 2}, {1, 3}, {2, 3}};
  for (int a = 0; a < 4; ++a) {
    N[a] = nodes == 4 ? b[a] : b[a] * (2 * b[a] - 1);
    for (int k = 0; k < 3; ++k) dN[3 * a + k] = nodes == 4 ? dB[a][k] : (4 * b[a] - 1) * dB[a][k];
  }
  for (int e = 0; e < 6 && nodes == 10; ++e) {
    const int i = edge[e][0], j = edge[e][1];
    N[4 + e] = 4 * b[i] * b[j];
    for (int k = 0; k < 3; ++k) dN[3 * (4 + e) + k] = 4 * (b[i] * dB[j][k] + b[j] * dB[i][k]);
  }
}

// 4 points (degree 2) or 14 points (degree 5, Walkington), as FreeFEM's qfV2 and qfV5
inline TetRule tet_rule(int nodes, int points) {
  TetRule r;
  r.nodes = nodes;
  std::vector<double> bary;
  auto add = [&](double b0, double b1, double b2, double b3, double w) {
    bary.insert(bary.end(), {b0, b1, b2, b3});
    r.w.push_back(w / 6.0);
  };
  auto add4 = [&](double a, double w) {  // the four points with one coordinate 1 - 3a
    const double c = 1 - 3 * a;
    add(c, a, a, a, w), add(a, c, a, a, w), add(a, a, c, a, w), add(a, a, a, c, w);
  };
  if (points == 4) {
    add4(0.13819660112501052, 0.25);
  } else {
    add4(0.31088591926330060980, 0.11268792571801585080);
    add4(0.09273525031089122640, 0.07349304311636194934);
    const double a = 0.04550370412564964949, c = 0.5 - a, w = 0.04254602077708146686;
    add(a, a, c, c, w), add(a, c, a, c, w), add(a, c, c, a, w), add(c, a, a, c, w), add(c, a, c, a, w), add(c, c, a, a, w);
  }
  r.n = (int)r.w.size();
  r.N.resize(r.n * nodes);
  r.L = bary;
  r.dN.resize(r.n * nodes * 3);
  for (int q = 0; q < r.n; ++q) tet_shapes(nodes, &bary[4 * q], &r.N[q * nodes], &r.dN[q * nodes * 3]);
  return r;
}

// 7 points (degree 5, Radon), as FreeFEM's qf5pT
inline TriRule tri_rule(int nodes) {
  TriRule r;
  r.nodes = nodes;
  const double s = 3.872983346207417;  // sqrt(15)
  const double a = (6 - s) / 21, b = (6 + s) / 21, wa = (155 - s) / 2400, wb = (155 + s) / 2400;
  const double bary[7][3] = {{1. / 3, 1. / 3, 1. / 3}, {1 - 2 * a, a, a}, {a, 1 - 2 * a, a}, {a, a, 1 - 2 * a},
                             {1 - 2 * b, b, b},         {b, 1 - 2 * b, b}, {b, b, 1 - 2 * b}};
  const double w[7] = {9. / 80, wa, wa, wa, wb, wb, wb};
  static const int edge[3][2] = {{1, 2}, {2, 0}, {0, 1}};
  static const double e1[3] = {-1, 1, 0}, e2[3] = {-1, 0, 1};
  r.n = 7;
  for (int q = 0; q < 7; ++q) {
    const double *l = bary[q];
    r.w.push_back(w[q]);
    for (int i = 0; i < 3; ++i) {
      r.N.push_back(nodes == 3 ? l[i] : l[i] * (2 * l[i] - 1));
      r.d1.push_back(nodes == 3 ? e1[i] : (4 * l[i] - 1) * e1[i]);
      r.d2.push_back(nodes == 3 ? e2[i] : (4 * l[i] - 1) * e2[i]);
    }
    for (int e = 0; e < 3 && nodes == 6; ++e) {
      const int i = edge[e][0], j = edge[e][1];
      r.N.push_back(4 * l[i] * l[j]);
      r.d1.push_back(4 * (l[i] * e1[j] + l[j] * e1[i]));
      r.d2.push_back(4 * (l[i] * e2[j] + l[j] * e2[i]));
    }
  }
  return r;
}

}  // namespace lacli
#endif
