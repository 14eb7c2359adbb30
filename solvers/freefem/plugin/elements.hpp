// Element integrals over the two maps X (reference) and x (deformed) of one parameter mesh.
// Forward problem: x and p unknown. Inverse problem: X and p unknown, x given.
#ifndef LACLI_ELEMENTS_HPP
#define LACLI_ELEMENTS_HPP
#include <cstring>

#include "law.hpp"
#include "shapes.hpp"

namespace lacli {

enum class Task { residual, forward, inverse };

struct CellData {
  Material material;
  double stab;               // weight of the pressure's local projection (linear displacements), 1/kPa
};

// local unknown of node a, component i (3 = pressure): 4 a + i
const int LOCAL = 40;

struct CellSums {
  double energy, minJ, minJX;
  double R[LOCAL], K[LOCAL][LOCAL];
};

// One cell. X, x: nodes' positions; p: 4 vertex pressures; fibres: [q][3] on the parameter cell (zero: none).
// Returns false where J or the reference map's determinant is not positive, or the law refuses.
// viscosity: kPa/mm2, added to the tangent alone, so that it damps a step and leaves the solution.
// stretch: what the material has been through before it was in the reference X, G of 9 numbers a point (null: nothing),
// F = grad x (grad X)^-1 G; integrals are over the unstretched volume.
inline bool cell_integral(const TetRule &rule, const CellData &cell, const double (*X)[3], const double (*x)[3],
                          const double *p, const double *fibres, const double *stretch, double viscosity, Task task,
                          CellSums &s) {
  const int nn = rule.nodes;
  s.energy = 0, s.minJ = s.minJX = 1e300;
  std::memset(s.R, 0, sizeof s.R);
  if (task != Task::residual) std::memset(s.K, 0, sizeof s.K);
  double volume = 0, meanL[4] = {0, 0, 0, 0}, LL[4][4] = {};
  Response r;
  double g[10][3], g0[10][3];                // shape gradients in the reference configuration, stretched and not
  for (int q = 0; q < rule.n; ++q) {
    const double *dN = &rule.dN[q * nn * 3], *L = &rule.L[4 * q];
    Mat H = {}, h = {}, Hi, Hg, D, F;         // Hg = H^-1 G, D = grad x (grad X)^-1
    for (int a = 0; a < nn; ++a)
      for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) {
          H[i][k] += X[a][i] * dN[3 * a + k];
          h[i][k] += x[a][i] * dN[3 * a + k];
        }
    const double JX = det(H);
    s.minJX = JX < s.minJX ? JX : s.minJX;
    if (!(JX > 0)) return false;
    inverse(H, JX, Hi);
    Mat G = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
    if (stretch) std::memcpy(G, stretch + 9 * q, sizeof G);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) Hg[i][j] = Hi[i][0] * G[0][j] + Hi[i][1] * G[1][j] + Hi[i][2] * G[2][j];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        D[i][j] = h[i][0] * Hi[0][j] + h[i][1] * Hi[1][j] + h[i][2] * Hi[2][j];
        F[i][j] = h[i][0] * Hg[0][j] + h[i][1] * Hg[1][j] + h[i][2] * Hg[2][j];
      }

    // the fibre is a material line: it follows the reference map
    const double *a0 = fibres + 3 * q;
    double f[3] = {0, 0, 0}, length = 0;
    if (a0[0] != 0 || a0[1] != 0 || a0[2] != 0) {
      double a[3];
      for (int i = 0; i < 3; ++i) a[i] = H[i][0] * a0[0] + H[i][1] * a0[1] + H[i][2] * a0[2];
      if (stretch) {                         // the fibre is one of the reference: before the stretch it was G^-1 a
        Mat Gi;
        inverse(G, det(G), Gi);
        for (int i = 0; i < 3; ++i) f[i] = Gi[i][0] * a[0] + Gi[i][1] * a[1] + Gi[i][2] * a[2];
      } else
        std::memcpy(f, a, sizeof f);
      length = std::sqrt(f[0] * f[0] + f[1] * f[1] + f[2] * f[2]);
      for (int i = 0; i < 3; ++i) f[i] /= length;
    }
    const double pq = L[0] * p[0] + L[1] * p[1] + L[2] * p[2] + L[3] * p[3];
    const int level = task == Task::residual ? 0 : task == Task::forward ? 1 : 2;
    const bool fine = respond(cell.material, F, f, pq, level, r);
    s.minJ = r.J < s.minJ ? r.J : s.minJ;
    if (!fine) return false;

    const double w = rule.w[q] * JX / (stretch ? det(G) : 1.0);
    s.energy += w * r.energy;
    double Pg[10][3], Fg[10][3];             // P g, F^-T g
    for (int a = 0; a < nn; ++a) {
      for (int I = 0; I < 3; ++I) {
        g[a][I] = Hg[0][I] * dN[3 * a] + Hg[1][I] * dN[3 * a + 1] + Hg[2][I] * dN[3 * a + 2];
        g0[a][I] = Hi[0][I] * dN[3 * a] + Hi[1][I] * dN[3 * a + 1] + Hi[2][I] * dN[3 * a + 2];
      }
      for (int i = 0; i < 3; ++i) {
        Pg[a][i] = r.P[i][0] * g[a][0] + r.P[i][1] * g[a][1] + r.P[i][2] * g[a][2];
        Fg[a][i] = r.Fit[i][0] * g[a][0] + r.Fit[i][1] * g[a][1] + r.Fit[i][2] * g[a][2];
        s.R[4 * a + i] += w * Pg[a][i];
      }
    }
    const double kq = cell.material.kq, gap = r.lnJ - (kq > 0 ? pq / kq : 0.0);
    for (int c = 0; c < 4; ++c) s.R[4 * c + 3] += w * L[c] * gap;
    volume += w;
    for (int c = 0; c < 4; ++c) {
      meanL[c] += w * L[c];
      for (int d = 0; d < 4; ++d) LL[c][d] += w * L[c] * L[d];
    }
    if (task == Task::residual) continue;

    for (int c = 0; c < 4; ++c)
      for (int d = 0; d < 4; ++d) s.K[4 * c + 3][4 * d + 3] -= kq > 0 ? w * L[c] * L[d] / kq : 0.0;
    if (viscosity > 0) {
      const double *N = &rule.N[q * nn], v = task == Task::inverse ? -w * viscosity : w * viscosity;
      for (int a = 0; a < nn; ++a)
        for (int b = 0; b < nn; ++b)
          for (int i = 0; i < 3; ++i) s.K[4 * a + i][4 * b + i] += v * N[a] * N[b];
    }
    for (int b = 0; b < nn; ++b) {
      double T[9][3];
      for (int k = 0; k < 9; ++k)
        for (int j = 0; j < 3; ++j)
          T[k][j] = w * (r.A[k][3 * j] * g[b][0] + r.A[k][3 * j + 1] * g[b][1] + r.A[k][3 * j + 2] * g[b][2]);
      if (task == Task::forward) {
        for (int a = 0; a < nn; ++a)
          for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
              s.K[4 * a + i][4 * b + j] += T[3 * i][j] * g[a][0] + T[3 * i + 1][j] * g[a][1] + T[3 * i + 2][j] * g[a][2];
        for (int c = 0; c < 4; ++c)
          for (int i = 0; i < 3; ++i) {
            s.K[4 * b + i][4 * c + 3] += w * L[c] * Fg[b][i];
            s.K[4 * c + 3][4 * b + i] += w * L[c] * Fg[b][i];
          }
        continue;
      }
      // inverse: moving X_b by d turns F by -(D d) g_b, g_a by -g_b (d.g0_a), the volume by d.g0_b, the fibre by
      // (1 - f f) d (g0_b.f)
      double M[9][3];
      const double bf = g0[b][0] * f[0] + g0[b][1] * f[1] + g0[b][2] * f[2];
      for (int k = 0; k < 9; ++k) {
        const double *V = r.dPdf[k];
        const double Vf = V[0] * f[0] + V[1] * f[1] + V[2] * f[2];
        for (int j = 0; j < 3; ++j)
          M[k][j] = w * bf * (V[j] - Vf * f[j]) - (T[k][0] * D[0][j] + T[k][1] * D[1][j] + T[k][2] * D[2][j]);
      }
      for (int a = 0; a < nn; ++a)
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j)
            s.K[4 * a + i][4 * b + j] += M[3 * i][j] * g[a][0] + M[3 * i + 1][j] * g[a][1] + M[3 * i + 2][j] * g[a][2] +
                                         w * (Pg[a][i] * g0[b][j] - Pg[b][i] * g0[a][j]);
      for (int c = 0; c < 4; ++c)
        for (int j = 0; j < 3; ++j) {
          s.K[4 * b + j][4 * c + 3] += w * L[c] * Fg[b][j];
          s.K[4 * c + 3][4 * b + j] += w * L[c] * (gap - 1.0) * g0[b][j];
        }
    }
  }
  if (cell.stab > 0) {
    // local pressure projection (Dohrmann and Bochev 2004): -stab/2 int (p - mean p)^2; for linear cells, where g is
    // constant and the volume's change along X_b is the volume times g_b
    for (int c = 0; c < 4; ++c)
      for (int d = 0; d < 4; ++d) {
        const double m = cell.stab * (LL[c][d] - meanL[c] * meanL[d] / volume);
        s.R[4 * c + 3] -= m * p[d];
        s.energy -= 0.5 * m * p[c] * p[d];
        if (task != Task::residual) s.K[4 * c + 3][4 * d + 3] -= m;
        for (int b = 0; b < nn && task == Task::inverse; ++b)
          for (int j = 0; j < 3; ++j) s.K[4 * c + 3][4 * b + j] -= m * p[d] * g0[b][j];
      }
  }
  return true;
}

enum Surface { PRESSURE = 0, VEIN_SPRING = 1, PERICARDIUM = 2, PERICARDIUM_OUTWARD = 3 };

struct FaceSums {
  double energy, volume, area;
  double R[18], K[18][18];                   // 3 a + i
};

// One boundary triangle (normal out of the wall). value: pressure in kPa or stiffness in kPa/mm; weight: at the rule's points.
inline void face_integral(const TriRule &rule, Surface kind, double value, const double *weight, const double (*X)[3],
                          const double (*x)[3], Task task, FaceSums &s) {
  const int nn = rule.nodes;
  s.energy = s.volume = s.area = 0;
  std::memset(s.R, 0, sizeof s.R);
  if (task != Task::residual) std::memset(s.K, 0, sizeof s.K);
  for (int q = 0; q < rule.n; ++q) {
    const double *N = &rule.N[q * nn], *d1 = &rule.d1[q * nn], *d2 = &rule.d2[q * nn];
    const double w = rule.w[q];
    double xq[3] = {}, Xq[3] = {}, x1[3] = {}, x2[3] = {}, X1[3] = {}, X2[3] = {};
    for (int a = 0; a < nn; ++a)
      for (int i = 0; i < 3; ++i) {
        xq[i] += N[a] * x[a][i], x1[i] += d1[a] * x[a][i], x2[i] += d2[a] * x[a][i];
        Xq[i] += N[a] * X[a][i], X1[i] += d1[a] * X[a][i], X2[i] += d2[a] * X[a][i];
      }
    if (kind == PRESSURE) {
      const double t[3] = {x1[1] * x2[2] - x1[2] * x2[1], x1[2] * x2[0] - x1[0] * x2[2], x1[0] * x2[1] - x1[1] * x2[0]};
      const double v = -w * (xq[0] * t[0] + xq[1] * t[1] + xq[2] * t[2]) / 3.0;  // cavity lies on the normal's side
      s.volume += v;
      s.energy -= value * v;
      for (int a = 0; a < nn; ++a)
        for (int i = 0; i < 3; ++i) s.R[3 * a + i] += value * w * N[a] * t[i];
      if (task != Task::forward) continue;
      const Mat c1 = {{0, -x1[2], x1[1]}, {x1[2], 0, -x1[0]}, {-x1[1], x1[0], 0}};
      const Mat c2 = {{0, -x2[2], x2[1]}, {x2[2], 0, -x2[0]}, {-x2[1], x2[0], 0}};
      for (int a = 0; a < nn; ++a)
        for (int b = 0; b < nn; ++b)
          for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) s.K[3 * a + i][3 * b + j] += value * w * N[a] * (d2[b] * c1[i][j] - d1[b] * c2[i][j]);
      continue;
    }
    const double T[3] = {X1[1] * X2[2] - X1[2] * X2[1], X1[2] * X2[0] - X1[0] * X2[2], X1[0] * X2[1] - X1[1] * X2[0]};
    const double area = std::sqrt(T[0] * T[0] + T[1] * T[1] + T[2] * T[2]);
    const double n[3] = {T[0] / area, T[1] / area, T[2] / area};
    const double u[3] = {xq[0] - Xq[0], xq[1] - Xq[1], xq[2] - Xq[2]};
    const double un = u[0] * n[0] + u[1] * n[1] + u[2] * n[2];
    double k = value * w * weight[q];
    s.area += w * area;
    if (kind == PERICARDIUM_OUTWARD && un <= 0) continue;
    const bool normal = kind != VEIN_SPRING;
    double force[3];
    for (int i = 0; i < 3; ++i) force[i] = k * area * (normal ? un * n[i] : u[i]);
    s.energy += 0.5 * k * area * (normal ? un * un : u[0] * u[0] + u[1] * u[1] + u[2] * u[2]);
    for (int a = 0; a < nn; ++a)
      for (int i = 0; i < 3; ++i) s.R[3 * a + i] += N[a] * force[i];
    if (task == Task::residual) continue;
    if (task == Task::forward) {
      for (int a = 0; a < nn; ++a)
        for (int b = 0; b < nn; ++b)
          for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) s.K[3 * a + i][3 * b + j] += k * area * N[a] * N[b] * (normal ? n[i] * n[j] : i == j);
      continue;
    }
    const Mat c1 = {{0, -X1[2], X1[1]}, {X1[2], 0, -X1[0]}, {-X1[1], X1[0], 0}};
    const Mat c2 = {{0, -X2[2], X2[1]}, {X2[2], 0, -X2[0]}, {-X2[1], X2[0], 0}};
    for (int b = 0; b < nn; ++b) {
      double D[3][3];                        // of the force along X_b
      for (int j = 0; j < 3; ++j) {
        double dT[3];
        for (int i = 0; i < 3; ++i) dT[i] = d2[b] * c1[i][j] - d1[b] * c2[i][j];
        const double ndT = n[0] * dT[0] + n[1] * dT[1] + n[2] * dT[2];
        const double udT = u[0] * dT[0] + u[1] * dT[1] + u[2] * dT[2];
        for (int i = 0; i < 3; ++i)
          D[i][j] = normal ? (udT - N[b] * T[j]) * n[i] + un * (dT[i] - n[i] * ndT)
                           : u[i] * ndT - (i == j ? N[b] * area : 0.0);
      }
      for (int a = 0; a < nn; ++a)
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j) s.K[3 * a + i][3 * b + j] += k * N[a] * D[i][j];
    }
  }
}

}  // namespace lacli
#endif
