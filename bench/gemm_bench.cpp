// Rate of the matrix product on one core (processor time), beside Eigen's, for the shapes that the networks use.
#include <Eigen/Core>
#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <ctime>
#include <utility>
#include <vector>

#include "core/gemm.h"

namespace {

using Matrix = Eigen::Matrix<float, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

/// Best of several runs of at least 20 ms each, in GFLOP/s.
template <class Body>
double rate(double flop, Body body) {
  double best = 0;
  for (int run = 0; run < 5; ++run) {
    int calls = 0;
    const std::clock_t begin = std::clock();
    double seconds = 0;
    while (seconds < 0.02) {
      body();
      ++calls;
      seconds = static_cast<double>(std::clock() - begin) / CLOCKS_PER_SEC;
    }
    best = std::max(best, flop * calls / seconds * 1e-9);
  }
  return best;
}

void report(const char* what, std::int64_t m, std::int64_t n, std::int64_t k, double ours, double theirs) {
  std::printf("%-22s m %5ld n %4ld k %5ld  %7.1f GFLOP/s, Eigen %7.1f, ratio %.2f\n", what, static_cast<long>(m),
              static_cast<long>(n), static_cast<long>(k), ours, theirs, ours / theirs);
}

void forward(std::int64_t rows, std::int64_t in, std::int64_t out) {
  const Matrix x = Matrix::Random(rows, in);
  const Matrix w = Matrix::Random(in, out);
  Matrix y = Matrix::Zero(rows, out);
  const double flop = 2.0 * static_cast<double>(rows * in * out);
  const double ours = rate(flop, [&] {
    semfield::gemm(semfield::Gemm<float>{.m = rows,
                                         .n = out,
                                         .k = in,
                                         .a = x.data(),
                                         .a_row = in,
                                         .b = w.data(),
                                         .b_row = out,
                                         .c = y.data(),
                                         .c_row = out,
                                         .relu = true});
  });
  const double theirs = rate(flop, [&] { y.noalias() = x * w; });
  report("forward x W, ReLU", rows, out, in, ours, theirs);
}

void weight_gradient(std::int64_t rows, std::int64_t in, std::int64_t out) {
  const Matrix x = Matrix::Random(rows, in);
  const Matrix dy = Matrix::Random(rows, out);
  Matrix dw = Matrix::Zero(in, out);
  const double flop = 2.0 * static_cast<double>(rows * in * out);
  const double ours = rate(flop, [&] {
    using semfield::View;
    semfield::gemm_at_b_add(View<const float>(x.data(), rows, static_cast<int>(in)),
                            View<const float>(dy.data(), rows, static_cast<int>(out)),
                            View<float>(dw.data(), in, static_cast<int>(out)));
  });
  const double theirs = rate(flop, [&] { dw.noalias() += x.transpose() * dy; });
  report("gradient x^T dy, +=", in, out, rows, ours, theirs);
}

}  // namespace

int main() {
  for (const auto& [in, out] : {std::pair<int, int>{32, 64},
                                {64, 64},
                                {64, 16},
                                {64, 3},
                                {256, 1},
                                {63, 256},
                                {256, 256},
                                {256, 128},
                                {128, 13}}) {
    forward(1024, in, out);
    weight_gradient(1024, in, out);
  }
  return 0;
}
