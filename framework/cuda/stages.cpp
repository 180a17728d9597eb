// The stages of a pass on the device, and the list of losses.
#include "core/check.h"
#include "core/error.h"
#include "cuda/kernels/kernels.h"
#include "cuda/matmul.h"

namespace semfield::cuda {

namespace {

constexpr std::int64_t kDensityBatch = std::int64_t{1} << 18;

const std::int32_t* set_live_rows(const std::int32_t* count) {
  const std::int32_t* const before = launch().live_rows;
  set_launch_rows(count);
  return before;
}

void copy(View<const std::byte> from, View<std::byte> to) {
  const cudaMemcpyKind kind = from.device == Device::cpu ? cudaMemcpyHostToDevice
                              : to.device == Device::cpu ? cudaMemcpyDeviceToHost
                                                         : cudaMemcpyDeviceToDevice;
  const auto bytes = [](std::int64_t count) { return static_cast<std::size_t>(count); };
  if (from.contiguous() && to.contiguous()) {
    check(cudaMemcpyAsync(to.data, from.data, bytes(to.size()), kind, launch().stream), "copying rays or results");
  } else {  // rows with gaps go one by one, which takes many times longer
    check(cudaMemcpy2DAsync(to.data, bytes(to.row_stride), from.data, bytes(from.row_stride), bytes(to.cols),
                            bytes(to.rows), kind, launch().stream),
          "copying rays or results");
  }
}

void keep(Workspace& arena, const Samples<float>& samples, View<const float> weight, float least, std::int64_t most,
          BranchTrace<float>& trace) {
  trace.samples.t = arena.take<float>(most, 1);
  trace.samples.delta = arena.take<float>(most, 1);
  trace.samples.ray_of_sample = arena.take<std::int32_t>(most, 1);
  trace.samples.count = most;
  trace.source = arena.take<std::int32_t>(most, 1);
  trace.weight = arena.take<float>(most, 1);
  keep_samples(samples, weight, least, trace);
}

ChosenSamples<float> reached(Workspace& arena, const Samples<float>& samples, View<const float> sigma,
                             const ReachedBy& rule, std::int64_t most) {
  ChosenSamples<float> chosen;
  chosen.samples.first = arena.take<std::int32_t>(samples.first.rows, 1);
  chosen.samples.t = arena.take<float>(most, 1);
  chosen.samples.delta = arena.take<float>(most, 1);
  chosen.samples.ray_of_sample = arena.take<std::int32_t>(most, 1);
  chosen.samples.count = most;
  chosen.source = arena.take<std::int32_t>(most, 1);
  const Workspace::Scope scope(arena);
  reached_samples(samples, sigma, rule, arena.take<std::int32_t>(samples.first.rows - 1, 1), chosen);
  return chosen;
}

void rounded_sum_backward(const Samples<float>& samples, const RoundedSumBackward<float>& sum) {
  hidden_backward(samples, HiddenBackward<__nv_bfloat16>{sum.weight, as_bf16(sum.hidden), sum.d_out, sum.dots,
                                                         as_bf16(sum.d_hidden), true, sum.blocked});
}

// The other values are looked at by the kernels that make or read them.
void guard(const GuardPlace<float>&, Guarded value, View<const float> values) {
  if (value == Guarded::semantic_feature) guard_finite(Stage::feature, values);
  if (value == Guarded::channel) guard_finite(Stage::channel, values);
}

Stages<float> make_stages() {
  Stages<float> s;
  s.head = &head_kernels();
  s.cameras = &camera_kernels();
  s.host_memory = false;
  s.density_batch = kDensityBatch;
  s.set_live_rows = set_live_rows;
  s.copy = copy;
  s.locate = [](const GuardPlace<float>& place, const Rays<float>& rays, const DomainMap& map, View<double> x) {
    locate(rays, *place.samples, map, x);
  };
  s.locate_backward = cuda::locate_backward;
  s.map_positions = cuda::map_positions;
  s.density_forward = cuda::density_forward;
  s.density_backward = cuda::density_backward;
  s.reached = reached;
  s.spread = spread_rows;
  s.composite_forward = cuda::composite_forward;
  s.composite_backward = cuda::composite_backward;
  s.fill = cuda::fill;
  s.count_up = cuda::count_up;
  s.add = cuda::add_rows<float, float>;
  s.keep = keep;
  s.join = join_inputs;
  s.drop_out = cuda::drop_out;
  s.sum_by_weight = hidden_forward<float>;
  s.sum_by_weight_backward = [](const Samples<float>& samples, View<const float> weight, View<const float> d_out,
                                View<float> d_values) {
    hidden_backward(samples, HiddenBackward<float>{weight, {}, d_out, {}, d_values});
  };
  s.rounded_sum = [](const Samples<float>& samples, View<const float> weight, View<const Bf16> hidden,
                     View<float> out) { hidden_forward<__nv_bfloat16>(samples, weight, as_bf16(hidden), out); };
  s.rounded_sum_backward = rounded_sum_backward;
  s.class_results = cuda::class_results;
  s.opacity_resolutions = cuda::opacity_resolutions;
  s.adam = cuda::adam_update;
  s.guard = guard;
  return s;
}

}  // namespace

const Stages<float>& stages() {
  static const Stages<float> table = make_stages();
  return table;
}

std::vector<DeviceLoss> loss_kernels(const LossList& losses, const KernelTables* tables) {
  SEMFIELD_CHECK(tables != nullptr || losses.empty(), "losses need kernel tables on a device");
  std::vector<DeviceLoss> found;
  for (const LossEntry& entry : losses.entries())
    found.push_back({entry.loss, entry.loss->kernel(Device::cuda, "loss '" + entry.type + "'", *tables)});
  return found;
}

void add_losses(Workspace& arena, const std::vector<DeviceLoss>& losses, std::uint32_t which, LossCall call,
                LossSums* sums) {
  const std::int64_t rays = call.values.first.rows - 1;
  const Workspace::Scope scope(arena);
  call.of_ray = arena.take<double>(rays, 1).data;
  for (std::size_t i = 0; i < losses.size(); ++i) {
    if ((which >> i & 1U) == 0) continue;
    call.scale = &launch().cell->loss_scale[i];
    losses[i].add(*losses[i].loss, call);
    sum_in_order(call.of_ray, rays, &sums->terms[i]);
  }
}

}  // namespace semfield::cuda
