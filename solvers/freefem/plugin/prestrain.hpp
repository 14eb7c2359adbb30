// Prestrain: the wall's strain in the image itself, without an unloaded shape. A field v on the image's mesh gives every point the
// stretch U = exp(sym grad v), with v chosen so that the stress balances the loads on the image's geometry. Strains are those of
// the nonlinear law, rotations do not enter: like linear elasticity, the problem is well-posed where a thin wall has no
// unloaded shape at all. Cauchy stress sigma = P(U) U / J; volume ln J = div v.
#ifndef LACLI_PRESTRAIN_HPP
#define LACLI_PRESTRAIN_HPP
#include "elements.hpp"

namespace lacli {

// Eigenvalues and eigenvectors (columns of V) of a symmetric matrix by Jacobi rotations.
inline void eigen(const Mat M, double value[3], Mat V) {
  Mat a;
  std::memcpy(a, M, sizeof a);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) V[i][j] = i == j;
  for (int sweep = 0; sweep < 30; ++sweep) {
    const double off = a[0][1] * a[0][1] + a[0][2] * a[0][2] + a[1][2] * a[1][2];
    const double on = a[0][0] * a[0][0] + a[1][1] * a[1][1] + a[2][2] * a[2][2];
    if (off <= 1e-32 * on || off == 0) break;
    for (int p = 0; p < 2; ++p)
      for (int q = p + 1; q < 3; ++q) {
        if (a[p][q] == 0) continue;
        const double theta = (a[q][q] - a[p][p]) / (2 * a[p][q]);
        const double t = (theta >= 0 ? 1.0 : -1.0) / (std::fabs(theta) + std::sqrt(theta * theta + 1));
        const double c = 1 / std::sqrt(t * t + 1), s = t * c;
        for (int k = 0; k < 3; ++k) {
          const double kp = a[k][p], kq = a[k][q];
          a[k][p] = c * kp - s * kq, a[k][q] = s * kp + c * kq;
        }
        for (int k = 0; k < 3; ++k) {
          const double pk = a[p][k], qk = a[q][k];
          a[p][k] = c * pk - s * qk, a[q][k] = s * pk + c * qk;
          const double vp = V[k][p], vq = V[k][q];
          V[k][p] = c * vp - s * vq, V[k][q] = s * vp + c * vq;
        }
      }
  }
  for (int i = 0; i < 3; ++i) value[i] = a[i][i];
}

// U = exp(e) of a symmetric e, its inverse, and dU[3 k + l] = dU / de_kl (e_kl and e_lk moved together by half each).
inline void exponential(const Mat e, Mat U, Mat Ui, double (*dU)[9]) {
  double v[3], x[3];
  Mat V;
  eigen(e, v, V);
  for (int i = 0; i < 3; ++i) x[i] = std::exp(v[i]);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      U[i][j] = Ui[i][j] = 0;
      for (int a = 0; a < 3; ++a) U[i][j] += V[i][a] * x[a] * V[j][a], Ui[i][j] += V[i][a] / x[a] * V[j][a];
    }
  if (!dU) return;
  double ratio[3][3];                        // divided differences of exp (Daleckii and Krein)
  for (int a = 0; a < 3; ++a)
    for (int b = 0; b < 3; ++b) {
      const double d = 0.5 * (v[a] - v[b]), shared = std::exp(0.5 * (v[a] + v[b]));
      ratio[a][b] = std::fabs(d) < 1e-4 ? shared * (1 + d * d / 6) : shared * std::sinh(d) / d;
    }
  for (int k = 0; k < 3; ++k)
    for (int l = 0; l < 3; ++l) {
      Mat inner;
      for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b) inner[a][b] = ratio[a][b] * 0.5 * (V[k][a] * V[l][b] + V[l][a] * V[k][b]);
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
          double s = 0;
          for (int a = 0; a < 3; ++a)
            for (int b = 0; b < 3; ++b) s += V[i][a] * inner[a][b] * V[j][b];
          dU[3 * k + l][3 * i + j] = s;
        }
    }
}

// The material direction f0 whose image along U is the fibre a of the image.
inline double unstretched(const Mat Ui, const double a[3], double f[3]) {
  for (int i = 0; i < 3; ++i) f[i] = Ui[i][0] * a[0] + Ui[i][1] * a[1] + Ui[i][2] * a[2];
  const double length = std::sqrt(f[0] * f[0] + f[1] * f[1] + f[2] * f[2]);
  for (int i = 0; i < 3 && length > 0; ++i) f[i] /= length;
  return length;
}

inline void strain(const double (*dN)[3], const double (*v)[3], int nn, Mat e) {
  Mat g = {};
  for (int a = 0; a < nn; ++a)
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < 3; ++k) g[i][k] += v[a][i] * dN[a][k];
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k) e[i][k] = 0.5 * (g[i][k] + g[k][i]);
}

// Gradients of the shape functions on the image's geometry X at point q; its determinant.
inline double image_gradients(const TetRule &rule, int q, const double (*X)[3], Mat H, double (*g)[3]) {
  const int nn = rule.nodes;
  const double *dN = &rule.dN[(size_t)q * nn * 3];
  Mat Hi;
  std::memset(H, 0, sizeof(Mat));
  for (int a = 0; a < nn; ++a)
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < 3; ++k) H[i][k] += X[a][i] * dN[3 * a + k];
  const double J = det(H);
  if (!(J > 0)) return J;
  inverse(H, J, Hi);
  for (int a = 0; a < nn; ++a)
    for (int k = 0; k < 3; ++k) g[a][k] = Hi[0][k] * dN[3 * a] + Hi[1][k] * dN[3 * a + 1] + Hi[2][k] * dN[3 * a + 2];
  return J;
}

// One cell of the prestrain problem on the image X; unknown v and p. The tangent is not symmetric: the stress has no potential in
// this strain. (Symmetrised, it costs as much to factorise and Newton's method turns linear.)
inline bool prestrain_integral(const TetRule &rule, const CellData &cell, const double (*X)[3], const double (*v)[3],
                               const double *p, const double *fibres, double viscosity, bool tangent, CellSums &s) {
  const int nn = rule.nodes;
  s.energy = 0, s.minJ = s.minJX = 1e300;
  std::memset(s.R, 0, sizeof s.R);
  if (tangent) std::memset(s.K, 0, sizeof s.K);
  double volume = 0, meanL[4] = {0, 0, 0, 0}, LL[4][4] = {};
  Response r;
  double g[10][3], dU[9][9];
  for (int q = 0; q < rule.n; ++q) {
    const double *L = &rule.L[4 * q];
    Mat H, e, U, Ui;
    const double JX = image_gradients(rule, q, X, H, g);
    s.minJX = JX < s.minJX ? JX : s.minJX;
    if (!(JX > 0)) return false;
    strain(g, v, nn, e);
    double size = 0;
    for (int i = 0; i < 9; ++i) size += e[i / 3][i % 3] * e[i / 3][i % 3];
    if (!(size < 9)) return false;           // stretches of e^3: no state of tissue
    exponential(e, U, Ui, tangent ? dU : nullptr);
    const double *a0 = fibres + 3 * q;
    double a[3], f[3] = {0, 0, 0};
    for (int i = 0; i < 3; ++i) a[i] = H[i][0] * a0[0] + H[i][1] * a0[1] + H[i][2] * a0[2];
    unstretched(Ui, a, f);
    const double pq = L[0] * p[0] + L[1] * p[1] + L[2] * p[2] + L[3] * p[3];
    const bool fine = respond(cell.material, U, f, pq, tangent ? 2 : 0, r);
    s.minJ = r.J < s.minJ ? r.J : s.minJ;
    if (!fine) return false;
    const double w = rule.w[q] * JX, w0 = w / r.J;
    s.energy += w0 * r.energy;
    Mat sigma = {};
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        sigma[i][j] = (r.P[i][0] * U[0][j] + r.P[i][1] * U[1][j] + r.P[i][2] * U[2][j]) / r.J;
    for (int b = 0; b < nn; ++b)
      for (int i = 0; i < 3; ++i) s.R[4 * b + i] += w * (sigma[i][0] * g[b][0] + sigma[i][1] * g[b][1] + sigma[i][2] * g[b][2]);
    const double kq = cell.material.kq, gap = r.lnJ - (kq > 0 ? pq / kq : 0.0);
    volume += w0;
    for (int c = 0; c < 4; ++c) {
      s.R[4 * c + 3] += w0 * L[c] * gap;
      meanL[c] += w0 * L[c];
      for (int d = 0; d < 4; ++d) LL[c][d] += w0 * L[c] * L[d];
    }
    if (!tangent) continue;

    for (int c = 0; c < 4; ++c)
      for (int d = 0; d < 4; ++d) s.K[4 * c + 3][4 * d + 3] -= kq > 0 ? w0 * L[c] * L[d] / kq : 0.0;
    if (viscosity > 0) {
      const double *N = &rule.N[q * nn];
      for (int b = 0; b < nn; ++b)
        for (int c = 0; c < nn; ++c)
          for (int i = 0; i < 3; ++i) s.K[4 * b + i][4 * c + i] += w * viscosity * N[b] * N[c];
    }
    // D = d sigma / d e, with the fibre of the image kept: d f0 = -(1 - f0 f0) U^-1 dU f0
    double D[9][9];
    for (int k = 0; k < 9; ++k) {
      const double *d = dU[k];
      double df[3], t[3], along = 0, change = 0;
      for (int i = 0; i < 3; ++i) t[i] = d[3 * i] * f[0] + d[3 * i + 1] * f[1] + d[3 * i + 2] * f[2];
      for (int i = 0; i < 3; ++i) df[i] = -(Ui[i][0] * t[0] + Ui[i][1] * t[1] + Ui[i][2] * t[2]);
      for (int i = 0; i < 3; ++i) along += df[i] * f[i];
      for (int i = 0; i < 3; ++i) df[i] -= along * f[i];
      change = k % 4 == 0 ? 1.0 : 0.0;       // d ln J = trace of d e
      Mat dP;
      for (int i = 0; i < 9; ++i) {
        double sum = r.dPdf[i][0] * df[0] + r.dPdf[i][1] * df[1] + r.dPdf[i][2] * df[2];
        for (int j = 0; j < 9; ++j) sum += r.A[i][j] * d[j];
        dP[i / 3][i % 3] = sum;
      }
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
          double sum = 0;
          for (int m = 0; m < 3; ++m) sum += dP[i][m] * U[m][j] + r.P[i][m] * d[3 * m + j];
          D[3 * i + j][k] = sum / r.J - sigma[i][j] * change;
        }
    }
    for (int b = 0; b < nn; ++b) {
      double T[9][3];
      for (int k = 0; k < 9; ++k)
        for (int j = 0; j < 3; ++j) T[k][j] = w * (D[k][3 * j] * g[b][0] + D[k][3 * j + 1] * g[b][1] + D[k][3 * j + 2] * g[b][2]);
      for (int c = 0; c < nn; ++c)
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j)
            s.K[4 * c + i][4 * b + j] += T[3 * i][j] * g[c][0] + T[3 * i + 1][j] * g[c][1] + T[3 * i + 2][j] * g[c][2];
      for (int c = 0; c < 4; ++c)
        for (int i = 0; i < 3; ++i) {
          s.K[4 * b + i][4 * c + 3] += w0 * L[c] * g[b][i];
          s.K[4 * c + 3][4 * b + i] += w0 * L[c] * g[b][i] * (1.0 - gap);
        }
    }
  }
  if (cell.stab > 0)                         // linear cells: g is constant, and the unstretched volume falls as div v grows
    for (int c = 0; c < 4; ++c)
      for (int d = 0; d < 4; ++d) {
        const double m = cell.stab * (LL[c][d] - meanL[c] * meanL[d] / volume);
        s.R[4 * c + 3] -= m * p[d];
        if (!tangent) continue;
        s.K[4 * c + 3][4 * d + 3] -= m;
        for (int b = 0; b < nn; ++b)
          for (int i = 0; i < 3; ++i) s.K[4 * c + 3][4 * b + i] += m * p[d] * g[b][i];
      }
  return true;
}

// The stretch that v gives each point of a cell of the image (9 numbers a point).
inline void prestretch(const TetRule &rule, const double (*X)[3], const double (*v)[3], double *G) {
  double g[10][3];
  for (int q = 0; q < rule.n; ++q) {
    Mat H, e, U, Ui;
    image_gradients(rule, q, X, H, g);
    strain(g, v, rule.nodes, e);
    exponential(e, U, Ui, nullptr);
    for (int i = 0; i < 9; ++i) G[9 * q + i] = U[i / 3][i % 3];
  }
}

}  // namespace lacli
#endif
