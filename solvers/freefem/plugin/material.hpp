// What a law is asked with and what it answers, at one point. kPa.
#ifndef LACLI_MATERIAL_HPP
#define LACLI_MATERIAL_HPP
#include <cmath>

namespace lacli {

typedef double Mat[3][3];

struct Material {
  int law;             // its place in LACLI_LAWS
  double c, alpha;     // kPa, a factor of the law's energy; -, a factor of its exponent
  double b[3];         // the law's own constants
  double kp, kq;       // kPa, the bulk modulus at the points and on the pressure field
};

struct Response {
  double energy, J, lnJ, Q;  // Q: of a law C/2 (exp Q - 1)
  bool exponential;        // whether it is such a law, Q a multiple of alpha; another leaves alpha alone
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

}  // namespace lacli
#endif
