// Kernels one by one, on one thread, over tiles of the size that training uses (Google Benchmark). Rates are of
// CPU time: `items_per_second` are rows or samples, `FLOP/s` the multiply-adds of matrix products, 2 each.
//
//   kernel_bench --benchmark_filter=gemm       # beside Eigen's product of the same shapes
//   kernel_bench --benchmark_repetitions=5 --benchmark_report_aggregates_only=true
#include <benchmark/benchmark.h>

#include <Eigen/Core>
#include <algorithm>
#include <fstream>
#include <memory>
#include <sstream>
#include <string>
#include <vector>

#include "compute/gemm.h"
#include "compute/layers.h"
#include "compute/parallel.h"
#include "core/rng.h"
#include "model/compositor.h"
#include "model/optim/adam.h"
#include "model/param_store.h"
#include "plugin/loader.h"
#include "studies/step_work.h"
#include "testkit/laws.h"

namespace {

using namespace semfield;
using benchmark::Counter;
using benchmark::State;

/// Uniform values in [low, high), 64-byte aligned.
template <class T>
class Block {
 public:
  Block(std::int64_t rows, std::int32_t cols, double low = -1, double high = 1)
      : memory_(static_cast<std::size_t>(rows * cols) + 64 / sizeof(T)) {
    T* data = memory_.data();
    while (reinterpret_cast<std::uintptr_t>(data) % 64 != 0) ++data;
    view = View<T>(data, rows, cols);
    const RandomAddress where{static_cast<std::uint64_t>(rows), static_cast<std::uint64_t>(cols), stream_id("bench")};
    for (std::int64_t i = 0; i < rows * cols; ++i) {
      data[i] = static_cast<T>(low + (high - low) * uniform01(where, static_cast<std::uint64_t>(i)));
    }
  }
  View<T> view;

 private:
  std::vector<T> memory_;
};

Registry& registry() {
  static Registry all = [] {
    Registry r;
    register_linked_plugins(r);
    return r;
  }();
  return all;
}

/// The part that `make` builds of a plugin's entry, with its tensors as training holds them.
template <class Part>
struct Component {
  std::unique_ptr<Part> part;
  ParamStore<float> store{1, 1, true};
  Workspace workspace;
  StepContext ctx;

  explicit Component(std::unique_ptr<Part> made) : part(std::move(made)) {
    store.add("bench", *part);
    ctx.training = true;
    ctx.workspace = &workspace;
    part->derive(ctx, tensors());
  }
  Tensors<float> tensors() const { return store.tensors(0); }
};

std::unique_ptr<PluginParams> params_of(PluginKind kind, const std::string& name, const testkit::Settings& settings) {
  return testkit::make_params(registry().get(kind, name), settings);
}

std::unique_ptr<Encoder<float>> encoder(const std::string& name, const testkit::Settings& settings) {
  return registry()
      .get(PluginKind::encoder, name)
      .encoder32(*params_of(PluginKind::encoder, name, settings), {}, registry().kernels());
}

void encode(State& state, const std::string& name, const testkit::Settings& settings, std::int64_t rows,
            bool backward) {
  Component<Encoder<float>> c(encoder(name, settings));
  const std::int32_t dims = c.part->traits().out_dims;
  Block<double> x(rows, 3, 0, 1);
  if (c.part->traits().domain == Domain::direction) {
    for (std::int64_t r = 0; r < rows; ++r) {
      double* d = x.view.row(r);
      const double length = std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
      for (int i = 0; i < 3; ++i) d[i] /= length;
    }
  }
  Block<float> y(rows, dims), dx(rows, 3);
  const bool learns = c.store.learned_count() > 0;
  for (auto _ : state) {
    if (backward) {
      c.part->backward(c.ctx, c.tensors(), x.view, y.view, learns ? View<float>() : dx.view);
    } else {
      c.part->forward(c.ctx, c.tensors(), x.view, y.view);
    }
    benchmark::ClobberMemory();
  }
  state.SetItemsProcessed(state.iterations() * rows);
}

/// Activations as layers read them.
template <class Act>
View<Act> activations(Block<float>& values, std::vector<std::byte>& memory) {
  if constexpr (std::is_same_v<Act, Bf16>) {
    memory.resize(activation_bytes<Bf16>(values.view.rows, values.view.cols));
    const View<Bf16> rounded = activation_rows<Bf16>(memory.data(), values.view.rows, values.view.cols);
    round_rows(values.view, rounded);
    return rounded;
  } else {
    return values.view;
  }
}

/// `layers` layers of one width behind each other, forward, with bias and ReLU.
template <class Act>
void layer_chain(State& state, int width, int layers) {
  constexpr std::int64_t kRows = 1024;
  const float bound = std::sqrt(6.F / static_cast<float>(width));  // activations keep their size
  Block<float> weight(static_cast<std::int64_t>(layers) * width, width, -bound, bound), bias(1, width);
  Block<float> a(kRows, width), b(kRows, width);
  std::vector<std::byte> memory[2];
  const View<Act> turns[2] = {activations<Act>(a, memory[0]), activations<Act>(b, memory[1])};
  std::vector<std::vector<std::uint32_t>> words(static_cast<std::size_t>(layers));
  std::vector<Layer<Act>> chain;
  for (int i = 0; i < layers; ++i) {
    Layer<Act> layer{.x = turns[i % 2], .weight = {}, .start = bias.view, .relu = true, .y = turns[(i + 1) % 2]};
    const View<const float> rows = weight.view.row_range(std::int64_t{i} * width, width);
    if constexpr (std::is_same_v<Act, Bf16>) {
      auto& packed = words[static_cast<std::size_t>(i)];
      packed.resize(static_cast<std::size_t>(packed_weight_words(width, width)));
      layer.weight = pack_weight(rows, false, packed.data());
    } else {
      layer.weight = rows;
    }
    chain.push_back(layer);
  }
  for (auto _ : state) {
    for (const Layer<Act>& layer : chain) apply(layer);
    benchmark::ClobberMemory();
  }
  state.counters["FLOP/s"] = Counter(2.0 * kRows * width * width * layers, Counter::kIsIterationInvariantRate);
}

template <class Act>
void layer_gradient(State& state, int in, int out) {
  constexpr std::int64_t kRows = 1024;
  Block<float> x(kRows, in), dy(kRows, out), dw(in, out);
  std::vector<std::byte> memory[2];
  const View<Act> rows = activations<Act>(x, memory[0]), dz = activations<Act>(dy, memory[1]);
  for (auto _ : state) {
    weight_gradient(rows, dz, dw.view, {});
    benchmark::ClobberMemory();
  }
  state.counters["FLOP/s"] = Counter(2.0 * kRows * in * out, Counter::kIsIterationInvariantRate);
}

void gemm_shape(State& state, int in, int out) {
  constexpr std::int64_t kRows = 1024;
  Block<float> x(kRows, in), w(in, out), y(kRows, out);
  for (auto _ : state) {
    gemm<float>(x.view, w.view, y.view);
    benchmark::ClobberMemory();
  }
  state.counters["FLOP/s"] = Counter(2.0 * kRows * in * out, Counter::kIsIterationInvariantRate);
}

void gemm_eigen(State& state, int in, int out) {
  using Matrix = Eigen::Matrix<float, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  constexpr std::int64_t kRows = 1024;
  const Matrix x = Matrix::Random(kRows, in), w = Matrix::Random(in, out);
  Matrix y = Matrix::Zero(kRows, out);
  for (auto _ : state) {
    y.noalias() = x * w;
    benchmark::ClobberMemory();
  }
  state.counters["FLOP/s"] = Counter(2.0 * kRows * in * out, Counter::kIsIterationInvariantRate);
}

/// One tile of `rays` rays with `per_ray` samples through a field; `backward` adds the gradients.
void field(State& state, const std::string& name, const FieldBuild& build, bool position_learns, std::int64_t rays,
           std::int64_t per_ray, bool backward) {
  const std::int64_t samples = rays * per_ray;
  Component<Field<float>> c(registry()
                                .get(PluginKind::field, name)
                                .field32(*params_of(PluginKind::field, name, {}), build, registry().kernels()));
  const std::int32_t feature = c.part->traits().feature_dims;
  Block<float> position(samples, build.position_dims), direction(rays, build.direction_dims);
  Block<std::int32_t> ray(samples, 1);
  for (std::int64_t m = 0; m < samples; ++m) ray.view(m, 0) = static_cast<std::int32_t>(m / per_ray);
  Block<float> sigma(samples, 1), rgb(samples, 3), features(samples, feature);
  Block<float> d_sigma(samples, 1), d_rgb(samples, 3), d_feature(samples, feature), dx(samples, build.position_dims);
  const std::size_t saved_bytes = c.part->saved_bytes(samples, rays);
  Block<std::uint8_t> saved(static_cast<std::int64_t>(saved_bytes), 1, 0, 1);
  const Saved memory(reinterpret_cast<std::byte*>(saved.view.data), saved_bytes);
  const FieldIn<float> in{position.view, direction.view, ray.view};
  const FieldOut<float> out{sigma.view, rgb.view, features.view};
  for (auto _ : state) {
    c.part->forward(c.ctx, c.tensors(), in, out, memory);
    if (backward) {
      c.part->backward(c.ctx, c.tensors(), in, out, {d_sigma.view, d_rgb.view, d_feature.view}, memory,
                       position_learns ? dx.view : View<float>());
    }
    benchmark::ClobberMemory();
  }
  double flop = 0;
  for (const LayerWork& layer : field_work(*c.part, rays, samples, position_learns)) {
    if (layer.once_a_step) continue;  // not in these calls
    flop += backward ? layer.flop() : 2 * layer.rows * layer.in * layer.out;
  }
  state.SetItemsProcessed(state.iterations() * samples);
  state.counters["FLOP/s"] = Counter(flop, Counter::kIsIterationInvariantRate);
}

/// Samples of `rays` rays, `per_ray` each, evenly over 1 m.
struct EvenSamples {
  EvenSamples(std::int64_t rays, std::int64_t per_ray)
      : t(rays * per_ray, 1), delta(rays * per_ray, 1), ray(rays * per_ray, 1), first(rays + 1, 1) {
    for (std::int64_t m = 0; m < rays * per_ray; ++m) {
      t.view(m, 0) = (static_cast<float>(m % per_ray) + 0.5F) / static_cast<float>(per_ray);
      delta.view(m, 0) = 1.F / static_cast<float>(per_ray);
      ray.view(m, 0) = static_cast<std::int32_t>(m / per_ray);
    }
    for (std::int64_t r = 0; r <= rays; ++r) first.view(r, 0) = static_cast<std::int32_t>(r * per_ray);
    samples = {t.view, delta.view, ray.view, first.view, rays * per_ray};
  }
  Block<float> t, delta;
  Block<std::int32_t> ray, first;
  Samples<float> samples;
};

void compositor(State& state, std::int64_t rays, std::int64_t per_ray, std::int32_t hidden, bool backward) {
  const std::int64_t count = rays * per_ray;
  EvenSamples even(rays, per_ray);
  Block<float> sigma(count, 1, 0, 4), rgb(count, 3, 0, 1), h(count, hidden, 0, 1), weight(count, 1);
  Block<float> color(rays, 3), depth(rays, 1), opacity(rays, 1), ray_hidden(rays, hidden);
  Block<float> d_sigma(count, 1), d_rgb(count, 3), d_hidden(count, hidden);
  CompositeIn<float> in;
  in.samples = &even.samples;
  in.sigma = sigma.view;
  in.rgb = rgb.view;
  in.hidden = h.view;
  const CompositeOut<float> out{color.view, depth.view, opacity.view, ray_hidden.view, weight.view};
  CompositeGrad<float> grad;
  grad.color = color.view;
  grad.hidden = ray_hidden.view;
  composite_forward<float>(in, out);
  for (auto _ : state) {
    if (backward) {
      composite_backward<float>(in, out, grad, d_sigma.view, d_rgb.view, d_hidden.view);
    } else {
      composite_forward<float>(in, out);
    }
    benchmark::ClobberMemory();
  }
  state.SetItemsProcessed(state.iterations() * count);
}

void sampler(State& state, const std::string& name, const testkit::Settings& settings) {
  constexpr std::int64_t kRays = 64;
  SamplerBuild build;
  build.bounds = {{-1, -1, -1}, {1, 1, 1}};
  build.near_m = 0;
  build.far_m = 1;
  Component<Sampler<float>> c(
      registry()
          .get(PluginKind::sampler, name)
          .sampler32(*params_of(PluginKind::sampler, name, settings), build, registry().kernels()));
  const std::int64_t previous_per_ray = c.part->traits().needs_previous ? 64 : 0;
  Block<double> origin(kRays, 3, -0.1, 0.1), direction(kRays, 3, 0, 0), near_far(kRays, 2, 0, 0);
  for (std::int64_t r = 0; r < kRays; ++r) {
    direction.view(r, 2) = 1;
    near_far.view(r, 1) = 1;
  }
  const Rays<float> rays{origin.view, direction.view, near_far.view};
  EvenSamples before(kRays, std::max<std::int64_t>(previous_per_ray, 1));
  Block<float> weight(before.samples.count, 1, 0, 1);
  const Proposal<float> proposal{&before.samples, weight.view};
  const std::int64_t capacity = c.part->capacity(kRays, previous_per_ray);
  Block<float> t(capacity, 1), delta(capacity, 1);
  Block<std::int32_t> ray(capacity, 1), first(kRays + 1, 1);
  Samples<float> out{t.view, delta.view, ray.view, first.view, 0};
  for (auto _ : state) {
    c.part->sample(c.ctx, c.tensors(), rays, previous_per_ray > 0 ? &proposal : nullptr, out);
    benchmark::ClobberMemory();
  }
  state.SetItemsProcessed(state.iterations() * out.count);
}

/// Rows of `cols` numbers; `touched` of 100 rows get a gradient (100: the dense rule).
void adam(State& state, std::int64_t rows, std::int32_t cols, int touched) {
  Block<float> value(rows, cols), grad(rows, cols), source(rows, cols), m(rows, cols, 0, 1e-3), v(rows, cols, 0, 1e-3);
  for (std::int64_t r = 0; r < rows; ++r) {
    const bool hit = uniform_below({1, 0, stream_id("touched")}, static_cast<std::uint64_t>(r), 100) <
                     static_cast<std::uint64_t>(touched);
    for (std::int32_t c = 0; c < cols && !hit; ++c) source.view(r, c) = 0;
  }
  const AdamStep step = adam_step({}, 1e-3, 100);
  for (auto _ : state) {
    if (touched == 100) {
      adam_dense<float>(step, value.view, source.view, m.view, v.view, 0, rows);
    } else {
      state.PauseTiming();  // the rule clears the gradients it has used
      std::copy_n(source.view.data, rows * cols, grad.view.data);
      state.ResumeTiming();
      adam_touched<float>(step, value.view, grad.view, m.view, v.view, 0, rows);
    }
    benchmark::ClobberMemory();
  }
  state.SetItemsProcessed(state.iterations() * rows);
}

template <class Body>
void add(const std::string& name, Body body) {
  benchmark::RegisterBenchmark(name.c_str(), body);
}

/// Calls with every row of settings that a plugin of the kind is measured with: its defaults, and the lines of
/// bench.txt in its folder ("log2_entries=19 levels=8").
template <class Body>
void for_rows(PluginKind kind, const Body& body) {
  for (const PluginEntry* entry : registry().entries()) {
    if (entry->kind != kind) continue;
    body(entry->name, entry->name, testkit::Settings{});
    std::ifstream file(std::string(SEMFIELD_SOURCE_DIR "/plugins/") + std::string(kind_name(kind)) + "s/" +
                       entry->name + "/bench.txt");
    for (std::string line; std::getline(file, line);) {
      testkit::Settings settings;
      std::istringstream words(line);
      for (std::string word; words >> word;) settings[word.substr(0, word.find('='))] = word.substr(word.find('=') + 1);
      body(entry->name, entry->name + "/" + line, settings);
    }
  }
}

void add_encoders() {
  for (const bool backward : {false, true}) {
    for_rows(PluginKind::encoder,
             [&](const std::string& name, const std::string& row, const testkit::Settings& settings) {
               // A learned encoder gets the rows of a whole step.
               const bool learns = Component<Encoder<float>>(encoder(name, settings)).store.learned_count() > 0;
               add("encode/" + row + (backward ? "/backward" : "/forward"),
                   [=](State& s) { encode(s, name, settings, learns ? 30720 : 1024, backward); });
             });
  }
}

void add_products() {
  for (const int width : {64, 256}) {
    const std::string size = std::to_string(width);
    add("gemm/chain_of_8/" + size + "/fp32", [=](State& s) { layer_chain<float>(s, width, 8); });
    add("gemm/chain_of_8/" + size + "/bf16", [=](State& s) { layer_chain<Bf16>(s, width, 8); });
    add("gemm/weight_gradient/" + size + "/fp32", [=](State& s) { layer_gradient<float>(s, width, width); });
    add("gemm/weight_gradient/" + size + "/bf16", [=](State& s) { layer_gradient<Bf16>(s, width, width); });
  }
  for (const auto& [in, out] : {std::pair<int, int>{32, 64},
                                {64, 64},
                                {64, 16},
                                {64, 3},
                                {63, 256},
                                {256, 256},
                                {256, 128},
                                {256, 1},
                                {128, 13}}) {
    const std::string shape = std::to_string(in) + "x" + std::to_string(out);
    add("gemm/" + shape + "/ours", [in = in, out = out](State& s) { gemm_shape(s, in, out); });
    add("gemm/" + shape + "/eigen", [in = in, out = out](State& s) { gemm_eigen(s, in, out); });
  }
}

void add_model() {
  FieldBuild small, deep;
  small.position_dims = 32;
  small.direction_dims = 16;
  deep.position_dims = 63;
  deep.direction_dims = 27;
  for (const bool backward : {false, true}) {
    const std::string way = backward ? "/forward_backward" : "/forward";
    for_rows(PluginKind::field, [&](const std::string& name, const std::string& row, const testkit::Settings&) {
      add("field/" + row + "/32_16_learned" + way, [=](State& s) { field(s, name, small, true, 34, 30, backward); });
      add("field/" + row + "/63_27" + way, [=](State& s) { field(s, name, deep, false, 4, 192, backward); });
    });
    const std::string pass = backward ? "/backward" : "/forward";
    add("compositor/4x192/hidden_128" + pass, [=](State& s) { compositor(s, 4, 192, 128, backward); });
    add("compositor/34x30/hidden_64" + pass, [=](State& s) { compositor(s, 34, 30, 64, backward); });
  }
  for_rows(PluginKind::sampler,
           [&](const std::string& name, const std::string& row, const testkit::Settings& settings) {
             add("sampler/" + row, [=](State& s) { sampler(s, name, settings); });
           });
  add("adam/dense/630k", [](State& s) { adam(s, 2461, 256, 100); });
  for (const int percent : {5, 50}) {
    add("adam/touched/2^17_rows_of_2/" + std::to_string(percent) + "%",
        [=](State& s) { adam(s, 1 << 17, 2, percent); });
  }
}

}  // namespace

int main(int argc, char** argv) {
  set_thread_count(1);
  add_encoders();
  add_products();
  add_model();
  benchmark::Initialize(&argc, argv);
  if (benchmark::ReportUnrecognizedArguments(argc, argv)) return 1;
  benchmark::RunSpecifiedBenchmarks();
  return 0;
}
