// Material laws at one point: energy, first Piola stress, tangent. kPa.
//
// A law is a header in laws/ with a function of its name, which answers for the wall without its volume (Response, in material.hpp). Its
// name stands in lacli/contracts/laws.py, from where the compiler gets LACLI_LAWS, X(name) for each, and their headers.
// Volume, all: U = kp/2 (ln J)^2 + p ln J - p^2 / (2 kq): kp + kq is the bulk modulus, p the pressure field
//   (tension positive), so that p = kq ln J where the field resolves it.
#ifndef LACLI_LAW_HPP
#define LACLI_LAW_HPP
#include "material.hpp"

namespace lacli {

enum LawNumber {
#define X(name) LAW_##name,
  LACLI_LAWS
#undef X
};

inline bool respond_of_law(const Material &m, const Mat F, const double f[3], int level, Response &r) {
  switch (m.law) {
#define X(name) case LAW_##name: return name(m, F, f, level, r);
    LACLI_LAWS
#undef X
  }
  return false;
}

// Evaluate a law. Returns false where F is inverted, not finite, or the law refuses.
// level 0: energy and stress; 1: and A; 2: and dPdf.
inline bool respond(const Material &m, const Mat F, const double f[3], double p, int level, Response &r) {
  r.J = det(F);
  if (!(r.J > 0.0) || !std::isfinite(r.J)) return false;
  r.lnJ = std::log(r.J), r.Q = 0, r.exponential = false;
  Mat Fi;
  inverse(F, r.J, Fi);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) r.Fit[i][j] = Fi[j][i];
  if (!respond_of_law(m, F, f, level, r)) return false;
  const double volumetric = m.kp * r.lnJ + p;
  r.energy += 0.5 * m.kp * r.lnJ * r.lnJ + p * r.lnJ - (m.kq > 0 ? 0.5 * p * p / m.kq : 0.0);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) r.P[i][j] += volumetric * r.Fit[i][j];
  if (level >= 1)
    for (int i = 0; i < 3; ++i)
      for (int I = 0; I < 3; ++I)
        for (int j = 0; j < 3; ++j)
          for (int J = 0; J < 3; ++J)
            r.A[3 * i + I][3 * j + J] += m.kp * r.Fit[i][I] * r.Fit[j][J] - volumetric * r.Fit[i][J] * r.Fit[j][I];
  return std::isfinite(r.energy);
}

}  // namespace lacli
#endif
