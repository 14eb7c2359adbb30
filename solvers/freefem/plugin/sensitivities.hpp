// Derivatives of the residual by the inputs, at a state x with pressures p whose reference X has the prestrain of a field v:
// directly, and through v where its own derivatives are given. In the image itself (x = X) the direct ones are those of
// the prestrain problem as well: both residuals are one there, whatever the inputs.
#ifndef LACLI_SENSITIVITIES_HPP
#define LACLI_SENSITIVITIES_HPP
#include "model.hpp"

namespace lacli {

// C and alpha by region, pressures at end-diastole and end-systole, stiffness of the pericardium, its threshold, vein springs
enum Input { C_REGION = 0, ALPHA_REGION = 5, EDP = 10, ESP = 11, K_PERI = 12, PTH = 13, VEINS = 14, INPUTS = 15 };

// One cell. region: 0 to 4, else no region of the body. dv: of its nodes along each input (where moves). to: += by input.
// A linear cell has one strain: it is evaluated once, with its mean pressure, in which the stress is linear.
// Returns false as cell_integral.
inline bool cell_slopes(const TetRule &rule, const CellData &cell, int region, const double (*X)[3], const double (*x)[3],
                        const double *p, const double *fibres, const double (*v)[3], const double (*dv)[10][3],
                        const bool *moves, double (*to)[LOCAL]) {
  const int nn = rule.nodes;
  const bool mine = region >= 0 && region < 5;
  bool any = false;
  for (int k = 0; k < INPUTS; ++k) any = any || moves[k];
  const Material &law = cell.material;
  double volume = 0, meanL[4] = {0, 0, 0, 0}, LL[4][4] = {}, trace[INPUTS] = {};
  double g[10][3], dU[9][9];
  Response r;
  for (int q = 0, next; q < rule.n; q = next) {
    next = nn == 4 ? rule.n : q + 1;         // points q to next have the same strain
    const double *dN = &rule.dN[(size_t)q * nn * 3];
    Mat H, h = {}, Hi, D, F, e, U, Ui;
    const double JX = image_gradients(rule, q, X, H, g);
    if (!(JX > 0)) return false;
    inverse(H, JX, Hi);
    for (int a = 0; a < nn; ++a)
      for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) h[i][k] += x[a][i] * dN[3 * a + k];
    strain(g, v, nn, e);
    exponential(e, U, Ui, any ? dU : nullptr);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) D[i][j] = h[i][0] * Hi[0][j] + h[i][1] * Hi[1][j] + h[i][2] * Hi[2][j];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) F[i][j] = D[i][0] * U[0][j] + D[i][1] * U[1][j] + D[i][2] * U[2][j];
    const double *a0 = fibres + 3 * q;
    double a[3], f[3] = {0, 0, 0};
    for (int i = 0; i < 3; ++i) a[i] = H[i][0] * a0[0] + H[i][1] * a0[1] + H[i][2] * a0[2];
    unstretched(Ui, a, f);
    double w = 0, mean = 0, rows[4] = {0, 0, 0, 0};  // rows: of the volume's change in the pressures' equations
    const double density = JX / det(U), lnJ = std::log(det(F));
    for (int k = q; k < next; ++k) {
      const double *L = &rule.L[4 * k], wk = rule.w[k] * density;
      const double pk = L[0] * p[0] + L[1] * p[1] + L[2] * p[2] + L[3] * p[3];
      const double gap = lnJ - (law.kq > 0 ? pk / law.kq : 0.0);
      w += wk, mean += wk * pk;
      for (int c = 0; c < 4; ++c) {
        rows[c] += wk * L[c] * (1 - gap), meanL[c] += wk * L[c];
        for (int d = 0; d < 4; ++d) LL[c][d] += wk * L[c] * L[d];
      }
    }
    mean /= w, volume += w;
    if (!respond(law, F, f, mean, any ? 2 : 0, r)) return false;
    const double volumetric = law.kp * r.lnJ + mean;
    // the residual is w P U g
    auto add = [&](int input, const Mat M) {
      for (int b = 0; b < nn; ++b)
        for (int i = 0; i < 3; ++i) to[input][4 * b + i] += M[i][0] * g[b][0] + M[i][1] * g[b][1] + M[i][2] * g[b][2];
    };
    if (mine) {                              // C is a factor of the stress without its volumetric part; alpha of Q
      Mat M;
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
          M[i][j] = 0;
          for (int k = 0; k < 3; ++k) M[i][j] += w / law.c * (r.P[i][k] - volumetric * r.Fit[i][k]) * U[k][j];
        }
      add(C_REGION + region, M);
      if (r.exponential) {
        for (int i = 0; i < 9; ++i) M[i / 3][i % 3] *= law.c * (1 + r.Q) / law.alpha;
        add(ALPHA_REGION + region, M);
      }
    }
    if (!any) continue;

    // B: of w P U along e, as dU of both halves; the fibre of the image is kept: d f = -(1 - f f) U^-1 dU f
    double B[9][9];
    for (int k = 0; k < 3; ++k)
      for (int l = k; l < 3; ++l) {
        const double *d = dU[3 * k + l];
        double dF[9], df[3], t[3], along = 0;
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j) dF[3 * i + j] = D[i][0] * d[j] + D[i][1] * d[3 + j] + D[i][2] * d[6 + j];
        for (int i = 0; i < 3; ++i) t[i] = d[3 * i] * f[0] + d[3 * i + 1] * f[1] + d[3 * i + 2] * f[2];
        for (int i = 0; i < 3; ++i) df[i] = -(Ui[i][0] * t[0] + Ui[i][1] * t[1] + Ui[i][2] * t[2]);
        for (int i = 0; i < 3; ++i) along += df[i] * f[i];
        for (int i = 0; i < 3; ++i) df[i] -= along * f[i];
        Mat dP;
        for (int i = 0; i < 9; ++i) {
          double sum = r.dPdf[i][0] * df[0] + r.dPdf[i][1] * df[1] + r.dPdf[i][2] * df[2];
          for (int j = 0; j < 9; ++j) sum += r.A[i][j] * dF[j];
          dP[i / 3][i % 3] = sum;
        }
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j) {
            double sum = 0;
            for (int m = 0; m < 3; ++m) sum += (dP[i][m] - (k == l) * r.P[i][m]) * U[m][j] + r.P[i][m] * d[3 * m + j];
            B[3 * k + l][3 * i + j] = w * sum;
          }
      }
    for (int input = 0; input < INPUTS; ++input) {
      if (!moves[input]) continue;
      Mat de, M = {};
      strain(g, dv[input], nn, de);
      for (int k = 0; k < 3; ++k)
        for (int l = k; l < 3; ++l)
          for (int i = 0; i < 9; ++i) M[i / 3][i % 3] += (k == l ? 1 : 2) * de[k][l] * B[3 * k + l][i];
      add(input, M);
      trace[input] = de[0][0] + de[1][1] + de[2][2];
      for (int c = 0; c < 4; ++c) to[input][4 * c + 3] += rows[c] * trace[input];
    }
  }
  if (cell.stab > 0)                         // stab is 1 / (C alpha ..); the unstretched volume falls with div v
    for (int c = 0; c < 4; ++c)
      for (int d = 0; d < 4; ++d) {
        const double m = cell.stab * (LL[c][d] - meanL[c] * meanL[d] / volume) * p[d];
        if (mine) to[C_REGION + region][4 * c + 3] += m / law.c;
        if (mine && r.exponential) to[ALPHA_REGION + region][4 * c + 3] += m / law.alpha;
        for (int input = 0; input < INPUTS; ++input) to[input][4 * c + 3] += m * trace[input];
      }
  return true;
}

// One loaded face on x, springs at rest on X. shares: of the pressure along EDP and ESP; slope: of the weights along PTH.
inline void face_slopes(const TriRule &rule, Surface kind, double value, const double *weight, const double *slope,
                        const double *shares, const double (*X)[3], const double (*x)[3], const double (*dv)[10][3],
                        const bool *moves, double (*to)[18]) {
  static FaceSums f;
  const int m = 3 * rule.nodes;
  if (kind == PRESSURE) {
    if (shares[0] == 0 && shares[1] == 0) return;
    face_integral(rule, kind, 1.0, weight, X, x, Task::residual, f);
    for (int i = 0; i < m; ++i) to[EDP][i] += shares[0] * f.R[i], to[ESP][i] += shares[1] * f.R[i];
    return;
  }
  face_integral(rule, kind, 1.0, weight, X, x, Task::inverse, f);
  for (int i = 0; i < m; ++i) to[kind == VEIN_SPRING ? VEINS : K_PERI][i] += f.R[i];
  for (int input = 0; input < INPUTS; ++input) {
    if (!moves[input]) continue;
    for (int i = 0; i < m; ++i)
      for (int j = 0; j < m; ++j) to[input][i] -= value * f.K[i][j] * dv[input][j / 3][j % 3];  // X = image - v
  }
  if (kind == VEIN_SPRING || !slope) return;
  face_integral(rule, kind, value, slope, X, x, Task::residual, f);
  for (int i = 0; i < m; ++i) to[PTH][i] += f.R[i];
}

// All of them, at y = (x | p): `to` has INPUTS columns of all unknowns. rates: as many columns of v's derivatives, or null.
// 0, or 1 as laAssemble.
inline long slopes(const Model &P, const double *y, const double *reference, const double *rates, const double *shares,
                   double *to) {
  const int nn = P.nn, m = P.face.nodes;
  const size_t n = P.system.n, nU = P.nU;
  std::fill(to, to + INPUTS * n, 0.0);
  bool moves[INPUTS];
  for (int k = 0; k < INPUTS; ++k)
    moves[k] = rates && std::any_of(rates + k * n, rates + k * n + 3 * nU, [](double v) { return v != 0; });
  static double cell[INPUTS][LOCAL], face[INPUTS][18], dv[INPUTS][10][3];
  double X[10][3], x[10][3], v[10][3], p[4];
  auto gather = [&](const int *node, int count) {
    for (int k = 0; k < INPUTS; ++k)
      if (moves[k])
        for (int a = 0; a < count; ++a)
          for (int i = 0; i < 3; ++i) dv[k][a][i] = rates[k * n + i * nU + node[a]];
  };
  for (int k = 0; k < P.nt; ++k) {
    const int *node = &P.nodes[(size_t)k * nn];
    for (int a = 0; a < nn; ++a)
      for (int i = 0; i < 3; ++i) {
        const size_t at = i * nU + node[a];
        X[a][i] = reference[at], x[a][i] = y[at];
        v[a][i] = P.anchor.empty() ? 0.0 : reference[at] - P.anchor[at];
      }
    for (int i = 0; i < 4; ++i) p[i] = y[3 * nU + P.pressures[4 * k + i]];
    gather(node, nn);
    std::memset(cell, 0, sizeof cell);
    if (!cell_slopes(P.rule, P.cells[k], P.regions[k], X, x, p, &P.fibres[(size_t)k * P.rule.n * 3], v, dv, moves, cell)) return 1;
    for (int input = 0; input < INPUTS; ++input) {
      for (int a = 0; a < nn; ++a)
        for (int i = 0; i < 3; ++i) to[input * n + i * nU + node[a]] += cell[input][4 * a + i];
      for (int i = 0; i < 4; ++i) to[input * n + 3 * nU + P.pressures[4 * k + i]] += cell[input][4 * i + 3];
    }
  }
  for (const Faces &set : P.faces)
    for (size_t k = 0; k < set.nodes.size() / m; ++k) {
      const int *node = &set.nodes[k * m];
      for (int a = 0; a < m; ++a)
        for (int i = 0; i < 3; ++i) {
          const size_t at = i * nU + node[a];
          x[a][i] = y[at], X[a][i] = P.anchor.empty() ? reference[at] : P.anchor[at];
        }
      gather(node, m);
      std::memset(face, 0, sizeof face);
      face_slopes(P.face, set.kind, P.loads[set.kind], &set.weight[k * P.face.n],
                  set.slope.empty() ? nullptr : &set.slope[k * P.face.n], shares, X, x, dv, moves, face);
      for (int input = 0; input < INPUTS; ++input)
        for (int a = 0; a < m; ++a)
          for (int i = 0; i < 3; ++i) to[input * n + i * nU + node[a]] += face[input][3 * a + i];
    }
  for (size_t i = 0; i < INPUTS * n; ++i)
    if (!std::isfinite(to[i])) return 1;
  return 0;
}

// K z = b for all columns b with the last factors, z = 0 on held unknowns; columns of zeros are not solved. 0, or an error.
inline long solve_all(Model &P, const double *b, double *z) {
  const size_t n = P.system.n;
  std::vector<double> right, left;
  std::vector<int> column;
  for (int k = 0; k < INPUTS; ++k)
    if (std::any_of(b + k * n, b + (k + 1) * n, [](double v) { return v != 0; })) {
      column.push_back(k);
      right.insert(right.end(), b + k * n, b + (k + 1) * n);
    }
  std::fill(z, z + INPUTS * n, 0.0);
  if (column.empty()) return 0;
  left.resize(right.size());
  const long error = P.mumps.solve(P.system, right.data(), left.data(), (int)column.size());
  for (size_t k = 0; k < column.size(); ++k)
    for (size_t i = 0; i < n; ++i) {
      if (P.system.fixed[i]) continue;
      z[column[k] * n + i] = left[k * n + i];
      if (!std::isfinite(left[k * n + i])) return -99;
    }
  return error;
}

// The positions' part to a file: input, coordinate, node in the order of `order` (unknown -> node), as 8-byte floats.
inline long write_rates(const Model &P, const char *file, const KN<long> &order, const double *rates) {
  const size_t nU = P.nU;
  std::vector<double> out(INPUTS * 3 * nU);
  for (size_t k = 0; k < INPUTS * 3; ++k)
    for (size_t i = 0; i < nU; ++i) out[k * nU + order[(long)i]] = rates[(k / 3) * P.system.n + (k % 3) * nU + i];
  FILE *stream = std::fopen(file, "wb");
  if (!stream) return 1;
  const bool whole = std::fwrite(out.data(), sizeof(double), out.size(), stream) == out.size();
  return std::fclose(stream) == 0 && whole ? 0 : 1;
}

// Numbers to a file one array after the other, and back, as 8-byte floats: 0, or 1.
inline long write_numbers(const char *file, const KN<double> &first, const KN<double> &then) {
  FILE *stream = std::fopen(file, "wb");
  if (!stream) return 1;
  bool whole = true;
  for (const KN<double> *a : {&first, &then})
    for (long i = 0; i < a->N(); ++i) {
      const double value = (*a)[i];
      whole = whole && std::fwrite(&value, sizeof value, 1, stream) == 1;
    }
  return std::fclose(stream) == 0 && whole ? 0 : 1;
}
inline long read_numbers(const char *file, KN<double> &a) {
  FILE *stream = std::fopen(file, "rb");
  if (!stream) return 1;
  bool whole = true;
  for (long i = 0; i < a.N(); ++i) {
    double value;
    whole = whole && std::fread(&value, sizeof value, 1, stream) == 1;
    if (whole) a[i] = value;
  }
  std::fclose(stream);
  return whole ? 0 : 1;
}

}  // namespace lacli
#endif
