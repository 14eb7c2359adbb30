// Guccione (transversely isotropic, depends on the fibre f alone), E = (F^T F - 1)/2:
//   W = C/2 (exp Q - 1),  Q = alpha [ b1 (f.Ef)^2 + 2 b2 |Ef|^2 + bt tr E^2 ],  b1 = bf - 2 bft + bt, b2 = bft - bt
//   which is alpha [ bf Eff^2 + 2 bft (Efs^2 + Efn^2) + bt (Ess^2 + Enn^2 + 2 Esn^2) ] for any s, n normal to f.
// Constants: bf, bft, bt.
#ifndef LACLI_GUCCIONE_HPP
#define LACLI_GUCCIONE_HPP
#include "../material.hpp"

namespace lacli {

inline bool guccione(const Material &m, const Mat F, const double f[3], int level, Response &r) {
  const double b1 = m.b[0] - 2 * m.b[1] + m.b[2], b2 = m.b[1] - m.b[2], bt = m.b[2];
  Mat E, B, S, FB;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      E[i][j] = 0.5 * (F[0][i] * F[0][j] + F[1][i] * F[1][j] + F[2][i] * F[2][j] - (i == j ? 1.0 : 0.0));
  double g[3], e = 0, gg = 0, tr2 = 0;  // g = E f, e = f.Ef
  for (int i = 0; i < 3; ++i) {
    g[i] = E[i][0] * f[0] + E[i][1] * f[1] + E[i][2] * f[2];
    e += g[i] * f[i];
    gg += g[i] * g[i];
    for (int j = 0; j < 3; ++j) tr2 += E[i][j] * E[i][j];
  }
  const double Q = m.alpha * (b1 * e * e + 2.0 * b2 * gg + bt * tr2);
  if (!(Q < Q_LIMIT)) return false;
  r.Q = Q, r.exponential = true;
  const double expQ = std::exp(Q), s = m.c * m.alpha * expQ;
  r.energy = 0.5 * m.c * std::expm1(Q);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      B[i][j] = b1 * e * f[i] * f[j] + b2 * (f[i] * g[j] + g[i] * f[j]) + bt * E[i][j];
      S[i][j] = s * B[i][j];
    }
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      FB[i][j] = F[i][0] * B[0][j] + F[i][1] * B[1][j] + F[i][2] * B[2][j];
      r.P[i][j] = s * FB[i][j];
    }
  if (level < 1) return true;

  double Ff[3];
  Mat FFt;
  for (int i = 0; i < 3; ++i) {
    Ff[i] = F[i][0] * f[0] + F[i][1] * f[1] + F[i][2] * f[2];
    for (int j = 0; j < 3; ++j) FFt[i][j] = F[i][0] * F[j][0] + F[i][1] * F[j][1] + F[i][2] * F[j][2];
  }
  for (int i = 0; i < 3; ++i)
    for (int I = 0; I < 3; ++I)
      for (int j = 0; j < 3; ++j)
        for (int J = 0; J < 3; ++J) {
          double M = b1 * Ff[i] * f[I] * Ff[j] * f[J];
          M += 0.5 * b2 * (Ff[i] * f[J] * F[j][I] + f[I] * f[J] * FFt[i][j] + F[i][J] * f[I] * Ff[j]);
          M += 0.5 * bt * F[i][J] * F[j][I];
          if (I == J) M += 0.5 * b2 * Ff[i] * Ff[j] + 0.5 * bt * FFt[i][j];
          double a = s * (2.0 * m.alpha * FB[i][I] * FB[j][J] + M);
          if (i == j) a += S[I][J];
          r.A[3 * i + I][3 * j + J] = a;
        }
  if (level < 2) return true;

  for (int k = 0; k < 3; ++k) {  // derivative along the k-th component of f
    double Eg_k = E[k][0] * g[0] + E[k][1] * g[1] + E[k][2] * g[2];
    const double dQ = m.alpha * (4.0 * b1 * e * g[k] + 4.0 * b2 * Eg_k);
    Mat dS;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const double di = i == k, dj = j == k;
        const double dB = b1 * (2.0 * g[k] * f[i] * f[j] + e * (di * f[j] + f[i] * dj)) +
                          b2 * (di * g[j] + f[i] * E[j][k] + E[i][k] * f[j] + g[i] * dj);
        dS[i][j] = s * (dQ * B[i][j] + dB);
      }
    for (int i = 0; i < 3; ++i)
      for (int I = 0; I < 3; ++I) r.dPdf[3 * i + I][k] = F[i][0] * dS[0][I] + F[i][1] * dS[1][I] + F[i][2] * dS[2][I];
  }
  return true;
}

}  // namespace lacli
#endif
