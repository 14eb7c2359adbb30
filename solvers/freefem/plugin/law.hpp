// Material laws at one point: energy, first Piola stress, tangent. kPa.
//
// Guccione (transversely isotropic, depends on the fibre f alone), E = (F^T F - 1)/2:
//   W = C/2 (exp Q - 1),  Q = alpha [ b1 (f.Ef)^2 + 2 b2 |Ef|^2 + bt tr E^2 ],  b1 = bf - 2 bft + bt, b2 = bft - bt
//   which is alpha [ bf Eff^2 + 2 bft (Efs^2 + Efn^2) + bt (Ess^2 + Enn^2 + 2 Esn^2) ] for any s, n normal to f.
// Neo-Hookean: W = c (I1 - 3) - 2 c ln J, stress-free at F = 1.
// Volume, both: U = kp/2 (ln J)^2 + p ln J - p^2 / (2 kq): kp + kq is the bulk modulus, p the pressure field
//   (tension positive), so that p = kq ln J where the field resolves it.
#ifndef LACLI_LAW_HPP
#define LACLI_LAW_HPP
#include <cmath>

namespace lacli {

typedef double Mat[3][3];

struct Material {
  int law;             // 0 Guccione, 1 neo-Hookean
  double c, alpha;     // kPa, -; for neo-Hookean c only
  double b1, b2, bt;   // combinations above
  double kp, kq;       // kPa, the bulk modulus at the points and on the pressure field
};

struct Response {
  double energy, J, lnJ, Q;  // Q 0 where the law has none
  Mat P, Fit;              // first Piola stress, F^-T (= dP/dp)
  double A[9][9];          // dP_iI / dF_jJ, row 3 i + I
  double dPdf[9][3];       // dP / df, f free (not kept at unit length)
};

inline double det(const Mat m) {
  return m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0]) +
         m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0]);
}

// m^-1, given its determinant
inline void inverse(const Mat m, double d, Mat r) {
  const double s = 1.0 / d;
  r[0][0] = (m[1][1] * m[2][2] - m[1][2] * m[2][1]) * s;
  r[0][1] = (m[0][2] * m[2][1] - m[0][1] * m[2][2]) * s;
  r[0][2] = (m[0][1] * m[1][2] - m[0][2] * m[1][1]) * s;
  r[1][0] = (m[1][2] * m[2][0] - m[1][0] * m[2][2]) * s;
  r[1][1] = (m[0][0] * m[2][2] - m[0][2] * m[2][0]) * s;
  r[1][2] = (m[0][2] * m[1][0] - m[0][0] * m[1][2]) * s;
  r[2][0] = (m[1][0] * m[2][1] - m[1][1] * m[2][0]) * s;
  r[2][1] = (m[0][1] * m[2][0] - m[0][0] * m[2][1]) * s;
  r[2][2] = (m[0][0] * m[1][1] - m[0][1] * m[1][0]) * s;
}

// exp(Q) beyond this is no state of tissue: the caller takes a smaller step
const double Q_LIMIT = 200.0;

// Evaluate a law. Returns false where F is inverted, not finite, or Q is beyond Q_LIMIT.
// level 0: energy and stress; 1: and A; 2: and dPdf.
inline bool respond(const Material &m, const Mat F, const double f[3], double p, int level, Response &r) {
  r.J = det(F);
  if (!(r.J > 0.0) || !std::isfinite(r.J)) return false;
  r.lnJ = std::log(r.J), r.Q = 0;
  Mat Fi;
  inverse(F, r.J, Fi);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) r.Fit[i][j] = Fi[j][i];
  const double volumetric = m.kp * r.lnJ + p;
  r.energy = 0.5 * m.kp * r.lnJ * r.lnJ + p * r.lnJ - (m.kq > 0 ? 0.5 * p * p / m.kq : 0.0);

  if (m.law == 1) {
    double i1 = 0;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) i1 += F[i][j] * F[i][j];
    r.energy += m.c * (i1 - 3.0) - 2.0 * m.c * r.lnJ;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) r.P[i][j] = 2.0 * m.c * (F[i][j] - r.Fit[i][j]) + volumetric * r.Fit[i][j];
    if (level >= 1)
      for (int i = 0; i < 3; ++i)
        for (int I = 0; I < 3; ++I)
          for (int j = 0; j < 3; ++j)
            for (int J = 0; J < 3; ++J)
              r.A[3 * i + I][3 * j + J] = (i == j && I == J ? 2.0 * m.c : 0.0) + m.kp * r.Fit[i][I] * r.Fit[j][J] +
                                          (2.0 * m.c - volumetric) * r.Fit[i][J] * r.Fit[j][I];
    if (level >= 2)
      for (int k = 0; k < 9; ++k) r.dPdf[k][0] = r.dPdf[k][1] = r.dPdf[k][2] = 0.0;
    return std::isfinite(r.energy);
  }

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
  const double Q = m.alpha * (m.b1 * e * e + 2.0 * m.b2 * gg + m.bt * tr2);
  if (!(Q < Q_LIMIT)) return false;
  r.Q = Q;
  const double expQ = std::exp(Q), s = m.c * m.alpha * expQ;
  r.energy += 0.5 * m.c * std::expm1(Q);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      B[i][j] = m.b1 * e * f[i] * f[j] + m.b2 * (f[i] * g[j] + g[i] * f[j]) + m.bt * E[i][j];
      S[i][j] = s * B[i][j];
    }
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      FB[i][j] = F[i][0] * B[0][j] + F[i][1] * B[1][j] + F[i][2] * B[2][j];
      r.P[i][j] = s * FB[i][j] + volumetric * r.Fit[i][j];
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
          double M = m.b1 * Ff[i] * f[I] * Ff[j] * f[J];
          M += 0.5 * m.b2 * (Ff[i] * f[J] * F[j][I] + f[I] * f[J] * FFt[i][j] + F[i][J] * f[I] * Ff[j]);
          M += 0.5 * m.bt * F[i][J] * F[j][I];
          if (I == J) M += 0.5 * m.b2 * Ff[i] * Ff[j] + 0.5 * m.bt * FFt[i][j];
          double a = s * (2.0 * m.alpha * FB[i][I] * FB[j][J] + M);
          if (i == j) a += S[I][J];
          r.A[3 * i + I][3 * j + J] = a + m.kp * r.Fit[i][I] * r.Fit[j][J] - volumetric * r.Fit[i][J] * r.Fit[j][I];
        }
  if (level < 2) return true;

  for (int k = 0; k < 3; ++k) {  // derivative along the k-th component of f
    double Eg_k = E[k][0] * g[0] + E[k][1] * g[1] + E[k][2] * g[2];
    const double dQ = m.alpha * (4.0 * m.b1 * e * g[k] + 4.0 * m.b2 * Eg_k);
    Mat dS;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const double di = i == k, dj = j == k;
        const double dB = m.b1 * (2.0 * g[k] * f[i] * f[j] + e * (di * f[j] + f[i] * dj)) +
                          m.b2 * (di * g[j] + f[i] * E[j][k] + E[i][k] * f[j] + g[i] * dj);
        dS[i][j] = s * (dQ * B[i][j] + dB);
      }
    for (int i = 0; i < 3; ++i)
      for (int I = 0; I < 3; ++I) r.dPdf[3 * i + I][k] = F[i][0] * dS[0][I] + F[i][1] * dS[1][I] + F[i][2] * dS[2][I];
  }
  return true;
}

}  // namespace lacli
#endif
