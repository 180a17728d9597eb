// Samples a second of the hash grid, forward and backward, beside the same sums as plain loops over Eigen vectors.
//
// Medians of alternating runs on uniformly random positions; ratios are our rate over the plain loop's, in the same
// run. Exits with 1 when the two disagree, so that nothing wrong is ever timed.
#include <Eigen/Core>
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <vector>

#include "compute/parallel.h"
#include "core/rng.h"
#include "encoders/hash_grid/hash_grid.h"

namespace {

using namespace semfield;

constexpr std::int64_t kRows = 30720;  // 1,024 rays of 30 samples
constexpr int kRepeats = 9;

struct Problem {
  HashGridShape shape;
  std::vector<double> x;
  std::vector<float> y, y_plain, dy;
  std::vector<std::vector<float>> table, grad, grad_plain;
  std::vector<View<float>> value, grads;
};

Problem make_problem(const HashGridParams& params) {
  Problem p;
  p.shape = hash_grid_shape(params);
  const auto width = static_cast<std::size_t>(params.levels * params.features);
  const RandomAddress where{1, 0, stream_id("bench")};
  std::uint64_t next = 0;
  const auto random = [&] { return uniform01(where, next++); };
  p.x.resize(3 * kRows);
  for (double& v : p.x) v = random();
  p.y.resize(kRows * width);
  p.y_plain.resize(kRows * width);
  p.dy.resize(kRows * width);
  for (float& v : p.dy) v = random() - 0.5f;
  for (int l = 0; l < params.levels; ++l) {
    const auto size = static_cast<std::size_t>(p.shape.level[l].entries * params.features);
    p.table.emplace_back(size);
    for (float& v : p.table.back()) v = random() - 0.5f;
    p.grad.emplace_back(size, 0.f);
    p.grad_plain.emplace_back(size, 0.f);
  }
  for (std::size_t l = 0; l < p.table.size(); ++l) {
    p.value.emplace_back(p.table[l].data(), p.shape.level[l].entries, params.features);
    p.grads.emplace_back(p.grad[l].data(), p.shape.level[l].entries, params.features);
  }
  return p;
}

/// Vertices and weights of one sample at one level, the way one writes it first.
struct Cell {
  std::int64_t entry[8];
  float weight[8];
};
Cell cell_of(const HashGridLevel& level, const double* x) {
  const Eigen::Vector3d scaled = Eigen::Vector3d(x[0], x[1], x[2]) * static_cast<double>(level.resolution);
  const Eigen::Vector3i base = scaled.array().floor().cast<int>().min(static_cast<int>(level.resolution) - 1);
  const Eigen::Vector3f w = (scaled - base.cast<double>()).cast<float>();
  Cell out;
  for (int c = 0; c < 8; ++c) {
    const Eigen::Vector3i bit(c & 1, (c >> 1) & 1, c >> 2);
    const Eigen::Vector3i v = base + bit;
    out.weight[c] = 1;
    for (int d = 0; d < 3; ++d) out.weight[c] *= bit[d] != 0 ? w[d] : 1 - w[d];
    out.entry[c] = level.dense
                       ? dense_index<std::int64_t>(v[0], v[1], v[2], level.resolution + 1)
                       : hash_index(static_cast<std::uint32_t>(v[0]), static_cast<std::uint32_t>(v[1]),
                                    static_cast<std::uint32_t>(v[2]), static_cast<std::uint32_t>(level.entries) - 1);
  }
  return out;
}

void plain_forward(Problem& p) {
  for (std::int64_t r = 0; r < kRows; ++r) {
    for (int l = 0; l < p.shape.levels; ++l) {
      const Cell cell = cell_of(p.shape.level[l], &p.x[static_cast<std::size_t>(3 * r)]);
      const float* table = p.table[static_cast<std::size_t>(l)].data();
      Eigen::Vector2f sum = Eigen::Vector2f::Zero();
      for (int c = 0; c < 8; ++c) sum += cell.weight[c] * Eigen::Map<const Eigen::Vector2f>(table + 2 * cell.entry[c]);
      Eigen::Map<Eigen::Vector2f>(&p.y_plain[static_cast<std::size_t>((r * p.shape.levels + l) * 2)]) = sum;
    }
  }
}

void plain_backward(Problem& p) {
  for (std::int64_t r = 0; r < kRows; ++r) {
    for (int l = 0; l < p.shape.levels; ++l) {
      const Cell cell = cell_of(p.shape.level[l], &p.x[static_cast<std::size_t>(3 * r)]);
      float* grad = p.grad_plain[static_cast<std::size_t>(l)].data();
      const Eigen::Map<const Eigen::Vector2f> d(&p.dy[static_cast<std::size_t>((r * p.shape.levels + l) * 2)]);
      for (int c = 0; c < 8; ++c) Eigen::Map<Eigen::Vector2f>(grad + 2 * cell.entry[c]) += cell.weight[c] * d;
    }
  }
}

double seconds(const auto& call) {
  const auto begin = std::chrono::steady_clock::now();
  call();
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
}

double median(std::vector<double> v) {
  std::sort(v.begin(), v.end());
  return v[v.size() / 2];
}

/// Largest difference over the largest magnitude.
double difference(const std::vector<float>& a, const std::vector<float>& b) {
  double worst = 0, scale = 1e-30;
  for (std::size_t i = 0; i < a.size(); ++i) {
    worst = std::max(worst, std::fabs(static_cast<double>(a[i]) - b[i]));
    scale = std::max(scale, std::fabs(static_cast<double>(b[i])));
  }
  return worst / scale;
}

bool measure(int log2_entries) {
  HashGridParams params;
  params.log2_entries = log2_entries;
  Problem p = make_problem(params);
  KernelTables kernels;
  hash_grid_kernels(kernels);
  const HashGrid<float> encoder(params, {}, kernels);
  const Tensors<float> tensors{p.value, p.grads};
  const std::int32_t width = params.levels * params.features;
  const View<const double> x(p.x.data(), kRows, 3);
  const View<float> y(p.y.data(), kRows, width);
  const View<const float> dy(p.dy.data(), kRows, width);
  Workspace workspace;
  StepContext ctx;
  ctx.workspace = &workspace;
  const auto forward = [&] { encoder.forward(ctx, tensors, x, y); };  // a step's rows in one call, as in training
  const auto backward = [&] { encoder.backward(ctx, tensors, x, dy, {}); };

  forward();
  backward();
  plain_forward(p);
  plain_backward(p);
  double worst = difference(p.y, p.y_plain);
  for (std::size_t l = 0; l < p.grad.size(); ++l) worst = std::max(worst, difference(p.grad[l], p.grad_plain[l]));
  if (!(worst < 1e-5)) {
    std::fprintf(stderr, "T = 2^%d: the two implementations differ by %g\n", log2_entries, worst);
    return false;
  }
  std::vector<double> times[6];
  for (int i = 0; i < kRepeats; ++i) {
    times[0].push_back(seconds([&] { plain_forward(p); }));
    times[1].push_back(seconds([&] { plain_backward(p); }));
    for (int threads = 1; threads <= 2; ++threads) {
      set_thread_count(threads);
      times[2 * threads].push_back(seconds(forward));
      times[2 * threads + 1].push_back(seconds(backward));
    }
  }
  set_thread_count(0);
  double rate[6];
  for (int i = 0; i < 6; ++i) rate[i] = kRows / median(times[i]) * 1e-6;
  std::printf("2^%-3d | %6.2f %6.2f | %6.2f %6.2f | %6.2f %6.2f | %5.2f %5.2f | %5.2f %5.2f\n", log2_entries, rate[0],
              rate[1], rate[2], rate[3], rate[4], rate[5], rate[2] / rate[0], rate[3] / rate[1], rate[4] / rate[2],
              rate[5] / rate[3]);
  return true;
}

}  // namespace

int main() {
  std::printf("hash grid, 16 levels of 2 features, %lld samples; millions of samples per second (forward, backward)\n",
              static_cast<long long>(kRows));
  std::printf("T     | plain, 1 core | ours, 1 thread| ours, 2 threads| ours / plain| 2 / 1 threads\n");
  bool good = true;
  for (int log2_entries : {15, 17, 19}) good = measure(log2_entries) && good;
  return good ? EXIT_SUCCESS : EXIT_FAILURE;
}
