// Rate of the fields on one core (processor time): forward alone, and forward with backward, over tiles of the size
// that training uses.
#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <ctime>
#include <string>
#include <vector>

#include "core/rng.h"
#include "fields/nerf_mlp/nerf_mlp.h"
#include "fields/tiny_mlp/tiny_mlp.h"

namespace {

using semfield::View;

/// Memory of a field's tensors and of one tile, 64-byte aligned, filled with uniform values.
class Arena {
 public:
  View<float> uniform(std::int64_t rows, std::int32_t cols, float bound) {
    const auto count = static_cast<std::size_t>(rows * cols);
    storage_.emplace_back(count + 16);
    float* data = storage_.back().data();
    while (reinterpret_cast<std::uintptr_t>(data) % 64 != 0) ++data;
    for (std::size_t i = 0; i < count; ++i) {
      data[i] = bound * (2 * semfield::uniform01({storage_.size(), 0, 0}, i) - 1);
    }
    return {data, rows, cols};
  }

 private:
  std::vector<std::vector<float>> storage_;
};

struct Collector final : semfield::ParamDeclarer {
  int tensor(semfield::TensorSpec spec) override {
    specs.push_back(spec);
    return static_cast<int>(specs.size()) - 1;
  }
  std::vector<semfield::TensorSpec> specs;
};

template <class Body>
double best_seconds(Body body) {
  double best = 1e9;
  for (int run = 0; run < 7; ++run) {
    int calls = 0;
    double seconds = 0;
    const std::clock_t begin = std::clock();
    while (seconds < 0.05) {
      body();
      ++calls;
      seconds = static_cast<double>(std::clock() - begin) / CLOCKS_PER_SEC;
    }
    best = std::min(best, seconds / calls);
  }
  return best;
}

/// `macs`: multiply-adds a sample, the direction's share once a ray.
void measure(const char* name, const semfield::Field<float>& field, const semfield::FieldBuild& build,
             std::int64_t samples, std::int64_t rays, bool with_d_position) {
  Arena arena;
  Collector declared;
  field.declare(declared);
  std::vector<View<float>> values, grads;
  double macs = 0;
  for (const semfield::TensorSpec& spec : declared.specs) {
    const auto bound = static_cast<float>(spec.init.high);
    values.push_back(arena.uniform(spec.rows, spec.cols, bound));
    grads.push_back(arena.uniform(spec.rows, spec.cols, 0));
    const bool folded_away = spec.name == "feature/weight" || spec.name == "view/weight";
    const bool weight = spec.name.size() > 7 && spec.name.compare(spec.name.size() - 7, 7, "/weight") == 0;
    if (weight && !(folded_away && build.savings.fold_feature_layer && build.direction_dims > 0)) {
      const bool sees_direction = spec.name == "color_0/weight";
      macs += static_cast<double>(spec.rows - (sees_direction ? build.direction_dims : 0)) * spec.cols;
    }
  }
  const semfield::Tensors<float> tensors{values, grads};
  semfield::Workspace workspace;
  semfield::StepContext ctx;
  ctx.workspace = &workspace;
  field.derive(ctx, tensors);
  const std::int32_t features = field.traits().feature_dims;
  std::vector<std::int32_t> ray_of(static_cast<std::size_t>(samples));
  for (std::size_t m = 0; m < ray_of.size(); ++m) {
    ray_of[m] = static_cast<std::int32_t>(static_cast<std::int64_t>(m) * rays / samples);
  }
  const semfield::FieldIn<float> in{arena.uniform(samples, build.position_dims, 1),
                                    arena.uniform(rays, build.direction_dims, 1),
                                    View<const std::int32_t>(ray_of.data(), samples, 1)};
  const semfield::FieldOut<float> out{arena.uniform(samples, 1, 1), arena.uniform(samples, 3, 1),
                                      arena.uniform(samples, features, 1)};
  const semfield::FieldGrad<float> grad{arena.uniform(samples, 1, 1e-3f), arena.uniform(samples, 3, 1e-3f),
                                        arena.uniform(samples, features, 1e-3f)};
  const View<float> d_position = with_d_position ? arena.uniform(samples, build.position_dims, 1) : View<float>();
  const std::size_t bytes = field.saved_bytes(samples, rays);
  const View<float> memory = arena.uniform(static_cast<std::int64_t>(bytes / 4), 1, 0);
  const semfield::Saved saved(reinterpret_cast<std::byte*>(memory.data), bytes);

  const double inference = best_seconds([&] { field.forward(ctx, tensors, in, out, {}); });
  const double forward = best_seconds([&] { field.forward(ctx, tensors, in, out, saved); });
  const double both = best_seconds([&] {
    field.forward(ctx, tensors, in, out, saved);
    field.backward(ctx, tensors, in, out, grad, saved, d_position);
  });
  const auto line = [&](const char* what, double seconds, double flop_a_sample) {
    std::printf("%-10s %-22s %8.3f M samples/s  %7.1f GFLOP/s\n", name, what,
                static_cast<double>(samples) / seconds * 1e-6,
                flop_a_sample * static_cast<double>(samples) / seconds * 1e-9);
  };
  // Backward: as many products again for the weights, and for the inputs (all but the first layer's, unless wanted).
  line("forward, nothing saved", inference, 2 * macs);
  line("forward", forward, 2 * macs);
  double first = 0;
  for (const semfield::TensorSpec& spec : declared.specs) {
    const bool reads_position = spec.name == "trunk_0/weight" || spec.name == "hidden_0/weight";
    const bool skip = spec.name == "trunk_5/weight";
    if (reads_position || skip) first += static_cast<double>(build.position_dims) * spec.cols;
  }
  line("forward + backward", both, 6 * macs - (with_d_position ? 0 : 2 * first));
}

}  // namespace

int main() {
  semfield::KernelTables tables;
  semfield::nerf_mlp_kernels(tables);
  semfield::tiny_mlp_kernels(tables);
  semfield::FieldBuild tiny;
  tiny.position_dims = 32;
  tiny.direction_dims = 16;
  measure("tiny_mlp", semfield::TinyMlp<float>({}, tiny, tables), tiny, 1024, 34, true);
  semfield::FieldBuild paper;
  paper.position_dims = 63;
  paper.direction_dims = 27;
  measure("nerf_mlp", semfield::NerfMlp<float>({}, paper, tables), paper, 768, 4, false);
  return 0;
}
