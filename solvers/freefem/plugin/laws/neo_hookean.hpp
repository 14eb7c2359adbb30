// Neo-Hookean: W = C (I1 - 3) - 2 C ln J, stress-free at F = 1.
#ifndef LACLI_NEO_HOOKEAN_HPP
#define LACLI_NEO_HOOKEAN_HPP
#include "../material.hpp"

namespace lacli {

inline bool neo_hookean(const Material &m, const Mat F, const double *, int level, Response &r) {
  double i1 = 0;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) i1 += F[i][j] * F[i][j];
  r.energy = m.c * (i1 - 3.0) - 2.0 * m.c * r.lnJ;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) r.P[i][j] = 2.0 * m.c * (F[i][j] - r.Fit[i][j]);
  if (level >= 1)
    for (int i = 0; i < 3; ++i)
      for (int I = 0; I < 3; ++I)
        for (int j = 0; j < 3; ++j)
          for (int J = 0; J < 3; ++J)
            r.A[3 * i + I][3 * j + J] = (i == j && I == J ? 2.0 * m.c : 0.0) + 2.0 * m.c * r.Fit[i][J] * r.Fit[j][I];
  if (level >= 2)
    for (int k = 0; k < 9; ++k) r.dPdf[k][0] = r.dPdf[k][1] = r.dPdf[k][2] = 0.0;
  return true;
}

}  // namespace lacli
#endif
