// Mean and variance of Gaussian processes at many points: what numpy does in many passes, done in one.
//
// For each output p and point with features phi (f):
//   k_i = exp(phi . exponent_i + shift)       correlation with run i of n
//   t   = (phi, k) . weights                  (q): t_0 the mean, the rest's squares add up to `linear_part`
//   v_j = sum_{i <= j} k_i root_ij            (j < used): their squares add up to `explained`
// The runs and q are padded to multiples of 8 with zeros in weights and roots.

// glibc's vectors of exponentials, without the other liberties of -ffast-math (linked, it would change the process's rounding)
extern "C" double exp(double) noexcept __attribute__((simd("notinbranch")));

namespace {

typedef double Vector __attribute__((vector_size(32), aligned(8)));
constexpr long kRows = 6;    // points of a tile: with its 8 columns, 12 sums stay in registers
constexpr long kBlock = 48;  // points of a block: their correlations stay in the first caches

struct Problem {
  long outputs, f, runs, q, used;  // runs and q padded
  const double *exponent, *weights, *roots;
};

// sums over `count` of left (R rows) times 8 columns of right
template <long R>
inline __attribute__((always_inline)) void tile(long count, const double* left, long left_stride, const double* right,
                                                long right_stride, Vector* low, Vector* high) {
  Vector a[R] = {}, b[R] = {};
  for (long i = 0; i < count; ++i) {
    const Vector x = *reinterpret_cast<const Vector*>(right + i * right_stride);
    const Vector y = *reinterpret_cast<const Vector*>(right + i * right_stride + 4);
#pragma GCC unroll 8
    for (long r = 0; r < R; ++r) {
      const double factor = left[r * left_stride + i];
      a[r] += factor * x;
      b[r] += factor * y;
    }
  }
  for (long r = 0; r < R; ++r) low[r] = a[r], high[r] = b[r];
}

inline double sum(Vector v) { return (v[0] + v[2]) + (v[1] + v[3]); }

// R points of one output; each row of work is (phi, k)
template <long R>
void points(const Problem& s, long p, double* work, const double* shift, double* mean, double* linear_part, double* explained) {
  const long stride = s.f + s.runs;
  Vector low[R], high[R];
  const double* exponent = s.exponent + p * s.f * s.runs;
  for (long j = 0; j < s.runs; j += 8) {
    tile<R>(s.f, work, stride, exponent + j, s.runs, low, high);
    for (long r = 0; r < R; ++r) {
      double* k = work + r * stride + s.f + j;
      for (long c = 0; c < 4; ++c) k[c] = low[r][c] + shift[r * s.outputs], k[c + 4] = high[r][c] + shift[r * s.outputs];
    }
  }
  for (long r = 0; r < R; ++r) {
    double* k = work + r * stride + s.f;
    for (long j = 0; j < s.runs; ++j) k[j] = exp(k[j]);
  }
  const double* weights = s.weights + p * stride * s.q;
  const long columns = s.used > 0 ? s.q : 8;
  double squares[R] = {};
  for (long j = 0; j < columns; j += 8) {
    tile<R>(stride, work, stride, weights + j, s.q, low, high);
    for (long r = 0; r < R; ++r) {
      if (j == 0) mean[r] = low[r][0], low[r][0] = 0.0;
      squares[r] += sum(low[r] * low[r] + high[r] * high[r]);
    }
  }
  for (long r = 0; r < R; ++r) linear_part[r] = s.used > 0 ? squares[r] : 0.0;
  double sums[R] = {};
  const double* roots = s.roots + p * s.runs * s.runs;
  for (long j = 0; j < s.used; j += 8) {
    tile<R>(j + 8, work + s.f, stride, roots + j, s.runs, low, high);
    for (long r = 0; r < R; ++r) sums[r] += sum(low[r] * low[r] + high[r] * high[r]);
  }
  for (long r = 0; r < R; ++r) explained[r] = sums[r];
}

}  // namespace

// phi (m, f); shift (m, outputs); exponent (outputs, f, runs); weights (outputs, f + runs, q); roots (outputs, runs, runs);
// `which` (count) numbers of outputs; `used` a multiple of 8, 0 for the mean alone (the rest is 0); work (48 (f + runs));
// mean, linear_part, explained (count, m)
extern "C" void moments(long m, long outputs, long f, long runs, long q, long count, const long* which, long used,
                        const double* phi, const double* shift, const double* exponent, const double* weights,
                        const double* roots, double* work, double* mean, double* linear_part, double* explained) {
  const Problem s{outputs, f, runs, q, used, exponent, weights, roots};
  const long stride = f + runs;
  for (long begin = 0; begin < m; begin += kBlock) {
    const long rows = m - begin < kBlock ? m - begin : kBlock;
    for (long r = 0; r < rows; ++r)
      for (long a = 0; a < f; ++a) work[r * stride + a] = phi[(begin + r) * f + a];
    for (long c = 0; c < count; ++c)
      for (long r = 0; r < rows;) {
        double* row = work + r * stride;
        const long point = begin + r, at = c * m + point;
        const double* first = shift + point * outputs + which[c];
        const auto fill = rows - r >= kRows ? points<kRows> : rows - r >= 3 ? points<3> : points<1>;
        fill(s, which[c], row, first, mean + at, linear_part + at, explained + at);
        r += rows - r >= kRows ? kRows : rows - r >= 3 ? 3 : 1;
      }
  }
}
