// Time of each encoder kernel on an NVIDIA GPU, for the rows of a training step along rays: medians of single
// calls between events, after a warm-up, with the bytes that must move at least.
#include <cuda_runtime_api.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <string>
#include <vector>

#include "core/error.h"
#include "core/rng.h"
#include "cuda/kernel_tables.h"
#include "cuda/launch.h"
#include "cuda/memory.h"
#include "encoders/frequency/frequency.h"
#include "encoders/hash_grid/hash_grid.h"
#include "encoders/spherical_harmonics/spherical_harmonics.h"

namespace {

using namespace semfield;

constexpr std::int64_t kRays = 4096, kSamples = 64, kRows = kRays * kSamples;  // 2^18
constexpr int kRepeats = 31;

struct Timer {
  Timer() {
    cuda::check(cudaEventCreate(&begin), "event");
    cuda::check(cudaEventCreate(&end), "event");
  }
  /// Median in microseconds.
  template <class F>
  double operator()(const F& f) const {
    std::vector<float> times;
    for (int i = 0; i < kRepeats + 3; ++i) {
      cuda::check(cudaEventRecord(begin, cuda::launch().stream), "event");
      f();
      cuda::check(cudaEventRecord(end, cuda::launch().stream), "event");
      cuda::check(cudaEventSynchronize(end), "event");
      float ms = 0;
      cuda::check(cudaEventElapsedTime(&ms, begin, end), "event");
      if (i >= 3) times.push_back(ms);
    }
    std::sort(times.begin(), times.end());
    return 1e3 * static_cast<double>(times[times.size() / 2]);
  }
  cudaEvent_t begin = nullptr, end = nullptr;
};

void print(const std::string& what, double us, double bytes) {
  std::printf("%-44s %8.1f us  %7.1f MB at least, %6.0f GB/s\n", what.c_str(), us, bytes / 1e6, bytes / us / 1e3);
}

template <class T>
cuda::Buffer<T> on_device(const std::vector<T>& values) {
  cuda::Buffer<T> buffer(values.size(), "a measurement");
  cuda::upload<T>(values, buffer.data());
  cuda::synchronize();
  return buffer;
}

/// Samples along rays through the unit cube.
std::vector<double> positions() {
  std::vector<double> x;
  for (std::int64_t ray = 0; ray < kRays; ++ray) {
    for (std::int64_t s = 0; s < kSamples; ++s) {
      for (std::uint64_t d = 0; d < 3; ++d) {
        const auto at = [&](std::uint64_t end) {
          return static_cast<double>(uniform01({1, 0, 1}, static_cast<std::uint64_t>(ray) * 6 + 2 * d + end));
        };
        x.push_back(at(0) + (at(1) - at(0)) * (static_cast<double>(s) + 0.5) / static_cast<double>(kSamples));
      }
    }
  }
  return x;
}

std::vector<float> random_floats(std::int64_t count) {
  std::vector<float> values(static_cast<std::size_t>(count));
  for (std::size_t i = 0; i < values.size(); ++i) values[i] = uniform01({2, 0, 2}, i) - 0.5F;
  return values;
}

class Declared final : public ParamDeclarer {
 public:
  int tensor(TensorSpec spec) override {
    specs.push_back(std::move(spec));
    return static_cast<int>(specs.size()) - 1;
  }
  std::vector<TensorSpec> specs;
};

template <class E, class Params>
void measure(const Timer& timer, const std::string& name, const Params& params, const KernelTables& kernels,
             View<const double> x, bool position_gradient) {
  EncoderBuild build;
  build.device = Device::cuda;
  const E encoder(params, build, kernels);
  Declared declared;
  encoder.declare(declared);
  std::vector<cuda::Buffer<float>> memory;
  std::vector<View<float>> values, grads;
  for (const TensorSpec& spec : declared.specs) {
    memory.push_back(on_device(random_floats(spec.rows * spec.cols)));
    values.push_back(memory.back().view(spec.rows, spec.cols));
    memory.emplace_back(static_cast<std::size_t>(spec.rows * spec.cols), "a measurement");
    grads.push_back(memory.back().view(spec.rows, spec.cols));
  }
  const std::int32_t cols = encoder.traits().out_dims;
  const cuda::Buffer<float> y(static_cast<std::size_t>(x.rows * cols), "a measurement");
  const cuda::Buffer<float> dy = on_device(random_floats(x.rows * cols));
  const cuda::Buffer<float> dx(static_cast<std::size_t>(3 * x.rows), "a measurement");
  Workspace arena(cuda::arena_source());
  StepContext ctx;
  ctx.workspace = &arena;
  const double bytes = static_cast<double>(x.rows) * (24 + 4.0 * cols);
  print(name + " forward", timer([&] { encoder.forward(ctx, {values, grads}, x, y.view(x.rows, cols)); }), bytes);
  const auto backward = [&] {
    const View<float> d = dy.view(x.rows, cols);
    encoder.backward(ctx, {values, grads}, x, d, position_gradient ? dx.view(x.rows, 3) : View<float>());
  };
  if (values.empty() && !position_gradient) return;
  print(name + " backward", timer(backward), bytes);
  if (values.empty()) return;
  cuda::Launch fixed = cuda::launch();
  fixed.deterministic = true;
  const cuda::LaunchScope scope(fixed);
  print(name + " backward, deterministic", timer(backward), bytes);
}

int run() {
  KernelTables kernels;
  cuda::add_plugin_kernels(kernels);
  cuda::Launch launch;
  cuda::check(cudaStreamCreate(&launch.stream), "stream");
  const cuda::LaunchScope scope(launch);
  cudaDeviceProp device{};
  cuda::check(cudaGetDeviceProperties(&device, 0), "device");
  std::printf("%s; %lld rows along %lld rays\n", device.name, static_cast<long long>(kRows),
              static_cast<long long>(kRays));
  const Timer timer;
  const std::vector<double> host_x = positions();
  const cuda::Buffer<double> x = on_device(host_x);
  const View<double> rows = x.view(kRows, 3);
  measure<Frequency<float>>(timer, "frequency, 10 bands,", FrequencyParams{}, kernels, rows, true);
  for (const int log2_entries : {15, 19, 21}) {
    HashGridParams params;
    params.log2_entries = log2_entries;
    measure<HashGrid<float>>(timer, "hash grid, 16 x 2, 2^" + std::to_string(log2_entries) + ",", params, kernels, rows,
                             false);
  }
  std::vector<double> directions = host_x;
  directions.resize(static_cast<std::size_t>(3 * kRays));
  for (std::size_t r = 0; r < directions.size(); r += 3) {
    const double norm = std::hypot(directions[r], directions[r + 1], directions[r + 2]);
    for (std::size_t d = r; d < r + 3; ++d) directions[d] /= norm;
  }
  const cuda::Buffer<double> d = on_device(directions);
  measure<SphericalHarmonics<float>>(timer, "spherical harmonics of the rays,", SphericalHarmonicsParams{}, kernels,
                                     d.view(kRays, 3), false);
  return 0;
}

}  // namespace

int main() {
  try {
    return run();
  } catch (const semfield::Error& e) {
    std::fprintf(stderr, "%s\n", e.what());
    return 1;
  }
}
