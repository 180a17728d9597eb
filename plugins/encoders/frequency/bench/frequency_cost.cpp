// Milliseconds that one step of configs/paper.yaml spends in the frequency encoding.
//
// Encodes what that step encodes - 64 and 192 positions of each of 1,024 rays with 10 bands, and a direction a ray and
// pass with 4 - in tiles of 1,024 rows, with one thread and with all of them; medians of alternating runs. There is no
// backward: the encoding learns nothing and hands no gradient to coordinates.
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <vector>

#include "compute/parallel.h"
#include "core/rng.h"
#include "encoders/frequency/frequency.h"

namespace {

using namespace semfield;

constexpr std::int64_t kRays = 1024, kTileRows = 1024;
constexpr int kRepeats = 15;

struct Problem {
  Problem(int frequencies, std::int64_t rows)
      : encoder({frequencies, true, Angular::radian}, {}, kernels()), x(static_cast<std::size_t>(rows * 3)) {
    const RandomAddress where{1, 0, stream_id("bench")};
    for (std::size_t i = 0; i < x.size(); ++i) x[i] = 2.0 * static_cast<double>(uniform01(where, i)) - 1.0;
  }
  static const KernelTables& kernels() {
    static const KernelTables tables = [] {
      KernelTables made;
      frequency_kernels(made);
      return made;
    }();
    return tables;
  }
  void encode() {
    const std::int64_t rows = static_cast<std::int64_t>(x.size()) / 3;
    const View<const double> from(x.data(), rows, 3);
    parallel_for((rows + kTileRows - 1) / kTileRows, [&](std::int64_t tile) {
      const std::int64_t begin = tile * kTileRows, count = std::min(kTileRows, rows - begin);
      static thread_local std::vector<float> y;  // a tile's output stays in the cache, as in a step
      y.resize(static_cast<std::size_t>(count * encoder.traits().out_dims));
      encoder.forward({}, {}, from.row_range(begin, count), {y.data(), count, encoder.traits().out_dims});
    });
  }
  Frequency<float> encoder;
  std::vector<double> x;
};

double median(std::vector<double> v) {
  std::sort(v.begin(), v.end());
  return v[v.size() / 2];
}

}  // namespace

int main() {
  Problem positions(10, kRays * (64 + 192)), directions(4, kRays * 2);
  std::vector<double> ms[2];
  for (int i = 0; i < kRepeats; ++i) {
    for (const int all : {0, 1}) {
      set_thread_count(all == 1 ? 0 : 1);
      const auto begin = std::chrono::steady_clock::now();
      positions.encode();
      directions.encode();
      ms[all].push_back(std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - begin).count());
    }
  }
  std::printf("262,144 positions with 10 bands and 2,048 directions with 4: %.1f ms on 1 thread, %.1f ms on %d\n",
              median(ms[0]), median(ms[1]), hardware_threads());
  return 0;
}
