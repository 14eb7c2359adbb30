// The sparse system: blocks of node pairs, factorised by MUMPS with its analysis kept between factorisations.
#ifndef LACLI_SYSTEM_HPP
#define LACLI_SYSTEM_HPP
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "mumps_seq/mpi.h"
#include "dmumps_c.h"

namespace lacli {

// Unknowns are numbered (x of all nodes | y | z | pressure of the vertices). A node owns 3 of them, or 4 at a vertex.
// A block belongs to a pair of nodes (a, b), a >= b; lower holds the rows of a, upper the rows of b, both at the
// same place with a's unknowns first.
struct System {
  int nU = 0, nP = 0, n = 0;
  std::vector<int> pressure;                 // node -> pressure unknown or -1
  std::vector<int> pairA, pairB;             // nodes of each block
  std::vector<size_t> start;                 // first value of each block
  std::vector<std::vector<std::pair<int, int>>> byNode;  // a -> (b, block), sorted
  std::vector<double> lower, upper;
  std::vector<char> fixed;                   // per unknown
  bool symmetric = true;

  int width(int node) const { return pressure[node] >= 0 ? 4 : 3; }
  int unknown(int node, int c) const { return c < 3 ? c * nU + node : 3 * nU + pressure[node]; }

  void pattern(int nU_, int nP_, const std::vector<int> &pressure_, std::vector<uint64_t> &keys) {
    nU = nU_, nP = nP_, n = 3 * nU + nP, pressure = pressure_;
    std::sort(keys.begin(), keys.end());
    keys.erase(std::unique(keys.begin(), keys.end()), keys.end());
    const size_t m = keys.size();
    pairA.resize(m), pairB.resize(m), start.resize(m + 1);
    byNode.assign(nU, {});
    size_t at = 0;
    for (size_t k = 0; k < m; ++k) {
      pairA[k] = (int)(keys[k] >> 32), pairB[k] = (int)(keys[k] & 0xffffffffu);
      start[k] = at;
      at += (size_t)width(pairA[k]) * width(pairB[k]);
      byNode[pairA[k]].push_back({pairB[k], (int)k});
    }
    start[m] = at;
    lower.assign(at, 0.0), upper.clear();
    fixed.assign(n, 0);
  }
  int block(int a, int b) const {            // a >= b
    const auto &row = byNode[a];
    auto it = std::lower_bound(row.begin(), row.end(), std::make_pair(b, -1));
    return it != row.end() && it->first == b ? it->second : -1;
  }
  void clear(bool sym) {
    symmetric = sym;
    std::fill(lower.begin(), lower.end(), 0.0);
    if (!sym) upper.assign(lower.size(), 0.0);
  }
  // y = K v with every unknown free
  void multiply(const double *v, double *y) const {
    std::fill(y, y + n, 0.0);
    for (size_t k = 0; k < pairA.size(); ++k) {
      const int a = pairA[k], b = pairB[k], wa = width(a), wb = width(b);
      const double *lo = &lower[start[k]], *up = symmetric ? lo : &upper[start[k]];
      for (int i = 0; i < wa; ++i)
        for (int j = 0; j < wb; ++j) {
          const int r = unknown(a, i), c = unknown(b, j);
          y[r] += lo[i * wb + j] * v[c];
          if (a != b) y[c] += up[i * wb + j] * v[r];
        }
    }
  }
};

class Mumps {
 public:
  Mumps() { id_.job = 0; }
  ~Mumps() { end(); }

  // 0, or MUMPS's error number; negative pivots of a symmetric matrix in `negative`
  int factor(const System &s, int ordering, int &negative) {
    if (!open_ || symmetric_ != s.symmetric || n_ != s.n) {
      end();
      begin(s, ordering);
      id_.job = 1;
      dmumps_c(&id_);
      if (id_.infog[0] < 0) return id_.infog[0];
    }
    fill(s);
    for (int attempt = 0; attempt < 4; ++attempt) {
      id_.job = 2;
      dmumps_c(&id_);
      if (id_.infog[0] != -8 && id_.infog[0] != -9) break;
      id_.icntl[13] *= 2;                    // more workspace, ask again
    }
    negative = id_.infog[11];
    return id_.infog[0] < 0 ? id_.infog[0] : 0;
  }
  // `count` right sides, one after the other
  int solve(const System &s, const double *b, double *x, int count = 1) {
    std::copy(b, b + (size_t)count * s.n, x);
    for (int k = 0; k < count; ++k)
      for (int i = 0; i < s.n; ++i)
        if (s.fixed[i]) x[(size_t)k * s.n + i] = 0.0;
    id_.rhs = x, id_.nrhs = count, id_.lrhs = s.n;
    id_.job = 3;
    dmumps_c(&id_);
    return id_.infog[0] < 0 ? id_.infog[0] : 0;
  }
  void end() {
    if (!open_) return;
    id_.job = -2;
    dmumps_c(&id_);
    open_ = false;
  }

 private:
  void begin(const System &s, int ordering) {
    symmetric_ = s.symmetric, n_ = s.n;
    id_.job = -1, id_.par = 1, id_.sym = s.symmetric ? 2 : 0, id_.comm_fortran = -987654;
    dmumps_c(&id_);
    open_ = true;
    for (int i = 0; i < 4; ++i) id_.icntl[i] = i < 3 ? -1 : 0;  // silent
    id_.icntl[6] = ordering;
    id_.icntl[13] = 30;
    id_.icntl[9] = 0;
    irn_.clear(), jcn_.clear();
    visit(s, [&](int r, int c, double) { irn_.push_back(r + 1), jcn_.push_back(c + 1); });
    a_.resize(irn_.size());
    id_.n = s.n, id_.nnz = (MUMPS_INT8)irn_.size(), id_.irn = irn_.data(), id_.jcn = jcn_.data(), id_.a = a_.data();
  }
  void fill(const System &s) {
    // fixed unknowns keep a diagonal of the matrix's own size, so that the scaling stays sane
    double scale = 0;
    size_t count = 0;
    for (size_t k = 0; k < s.pairA.size(); ++k)
      if (s.pairA[k] == s.pairB[k]) scale += std::fabs(s.lower[s.start[k]]), ++count;
    scale = count && scale > 0 ? scale / count : 1.0;
    size_t at = 0;
    visit(s, [&](int r, int c, double v) {
      a_[at++] = s.fixed[r] || s.fixed[c] ? (r == c ? scale : 0.0) : v;
    });
    id_.a = a_.data();
  }
  template <class Visitor>
  void visit(const System &s, Visitor visitor) {
    for (size_t k = 0; k < s.pairA.size(); ++k) {
      const int a = s.pairA[k], b = s.pairB[k], wa = s.width(a), wb = s.width(b);
      for (int i = 0; i < wa; ++i)
        for (int j = 0; j < wb; ++j) {
          const size_t at = s.start[k] + i * wb + j;
          const int r = s.unknown(a, i), c = s.unknown(b, j);
          if (a == b) {
            if (!s.symmetric || i >= j) visitor(r, c, s.lower[at]);
          } else {
            visitor(r, c, s.lower[at]);
            if (!s.symmetric) visitor(c, r, s.upper[at]);
          }
        }
    }
  }
  DMUMPS_STRUC_C id_;
  bool open_ = false, symmetric_ = true;
  int n_ = 0;
  std::vector<int> irn_, jcn_;
  std::vector<double> a_;
};

}  // namespace lacli
#endif
