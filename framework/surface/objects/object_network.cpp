#include "surface/objects/object_network.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <numbers>
#include <type_traits>

#include "compute/isa.h"
#include "core/rng.h"
#include "execution/device_library.h"
#include "model/optim/adam.h"
namespace semfield {

std::vector<PoolView> object_views(Session& session, std::int64_t rays, const ObjectProgress& progress) {
  std::vector<PoolView> views;
  double pixels = 0;
  std::int32_t shortest = 1 << 20;
  for (const int f : session.scene.frames_of(Split::train)) {
    const auto n = static_cast<std::size_t>(f);
    const FrameInfo& info = session.scene.info.frames[n];
    if (session.scene.frames[n].is_unusable()) continue;
    PoolView view;
    view.frame = f;
    view.camera = {info.camera, info.world_from_camera, session.plan.undistortion};
    view.photo = &session.scene.frames[n];
    pixels += static_cast<double>(info.camera.width_px) * info.camera.height_px;
    shortest = std::min({shortest, info.camera.width_px, info.camera.height_px});
    views.push_back(std::move(view));
  }
  const auto stride = std::clamp(static_cast<std::int32_t>(std::ceil(std::sqrt(pixels / static_cast<double>(rays)))), 1,
                                 std::max(1, shortest / 8));
  double done = 0;
  for (PoolView& view : views) {
    view.map = make_surface_map(*session.pipeline, view.camera, session.limits, stride, 0);
    if (progress) progress(++done, static_cast<double>(views.size()));
  }
  return views;
}

ObjectSurface object_surface(std::vector<PoolView> views, const RayLimits& limits, std::int64_t points) {
  ObjectSurface surface{std::move(views), {}};
  surface.pool = make_surface_pool(surface.views, limits, points);
  if (surface.pool.points.empty())
    throw Error(ErrorKind::data, "objects.surface.none", "no ray of a training view meets a surface",
                "train longer: the field is empty");
  return surface;
}

namespace {

// Places of a view by segment: `id_at` has the segment of a place of its map, 0: none; `class_of` its class.
template <class IdAt, class ClassOf>
SegmentSights sights_of(std::span<const std::int32_t> point_of, std::int64_t least, const IdAt& id_at,
                        const ClassOf& class_of) {
  std::map<std::int32_t, std::vector<std::int32_t>> points;
  for (std::size_t i = 0; i < point_of.size(); ++i) {
    if (point_of[i] < 0) continue;
    if (const std::int32_t id = id_at(i); id != 0) points[id].push_back(point_of[i]);
  }
  SegmentSights to;
  to.first.push_back(0);
  for (const auto& [id, of_segment] : points) {
    if (std::ssize(of_segment) < least) continue;
    to.point.insert(to.point.end(), of_segment.begin(), of_segment.end());
    to.segment.insert(to.segment.end(), of_segment.size(), to.segments());
    to.first.push_back(static_cast<std::int32_t>(to.point.size()));
    to.class_of.push_back(class_of(id));
  }
  return to;
}

}  // namespace

std::vector<SegmentSights> segment_sights(const ObjectSurface& surface, const SegmentSet& segments,
                                          std::int64_t least) {
  std::vector<SegmentSights> sights(surface.views.size());
  parallel_for(std::ssize(sights), [&](std::int64_t v) {
    const auto n = static_cast<std::size_t>(v);
    const PoolView& view = surface.views[n];
    const FrameSegments& of_frame = segments.frames[static_cast<std::size_t>(view.frame)];
    const auto id_at = [&](std::size_t i) {
      if (of_frame.empty()) return 0;
      const PixelPlace at = strided_place(static_cast<std::int64_t>(i), view.map.width_px, view.map.stride);
      return of_frame.at(at.column, at.row, view.camera.camera.width_px, view.camera.camera.height_px);
    };
    const auto class_of = [&](std::int32_t id) {
      const auto known = of_frame.class_of.find(id);
      return known == of_frame.class_of.end() ? kVoid : known->second;
    };
    sights[n] = sights_of(surface.pool.point_of_pixel[n], least, id_at, class_of);
  });
  return sights;
}

std::vector<SegmentSights> point_sights(const ObjectSurface& surface, std::span<const std::int32_t> id) {
  std::vector<SegmentSights> sights(surface.views.size());
  parallel_for(std::ssize(sights), [&](std::int64_t v) {
    const std::vector<std::int32_t>& point_of = surface.pool.point_of_pixel[static_cast<std::size_t>(v)];
    const auto id_at = [&](std::size_t i) { return id[static_cast<std::size_t>(point_of[i])]; };
    sights[static_cast<std::size_t>(v)] = sights_of(point_of, 1, id_at, [](std::int32_t) { return kVoid; });
  });
  return sights;
}

namespace {

constexpr std::int64_t kBlock = 1024;  // points of a unit of work
constexpr double kEndRate = 0.01;

template <class Real>
std::unique_ptr<Mlp<Real>> network_of(const KernelTables& kernels, std::int32_t inputs, std::int32_t outputs,
                                      const ObjectNetworkShape& shape, Device device = Device::cpu) {
  MlpBuild build;
  build.device = device;
  build.sample_dims = inputs;
  auto net = std::make_unique<Mlp<Real>>(build, kernels, kMlpOwner);
  const Rows hidden = net->chain({"hidden", {net->samples()}, static_cast<std::int32_t>(shape.hidden_width)},
                                 static_cast<int>(shape.hidden_layers));
  net->output(net->layer({"output", {hidden}, outputs, LayerActivation::none}));
  net->seal();
  return net;
}

// Draws of a view's points at addresses of a step: a segment by the root of its size, a point of it evenly.
class SightDraw {
 public:
  SightDraw(const SegmentSights& view, std::uint64_t seed, std::int64_t step)
      : view_(view),
        of_segment_{seed, static_cast<std::uint64_t>(step), stream_id("objects/segment")},
        of_point_{seed, static_cast<std::uint64_t>(step), stream_id("objects/point")} {
    double sum = 0;
    for (std::int32_t s = 0; s < view.segments(); ++s)
      up_to_.push_back(sum += std::sqrt(static_cast<double>(view.first[static_cast<std::size_t>(s) + 1] -
                                                            view.first[static_cast<std::size_t>(s)])));
  }
  // The place of a point among those of the view.
  std::size_t draw(std::uint64_t index) const {
    const double at = static_cast<double>(uniform01(of_segment_, index)) * up_to_.back();
    const auto s = static_cast<std::size_t>(
        std::min(std::upper_bound(up_to_.begin(), up_to_.end(), at) - up_to_.begin(), std::ssize(up_to_) - 1));
    const auto size = static_cast<std::uint64_t>(view_.first[s + 1] - view_.first[s]);
    return static_cast<std::size_t>(view_.first[s]) + uniform_below(of_point_, index, size);
  }

 private:
  const SegmentSights& view_;
  RandomAddress of_segment_, of_point_;
  std::vector<double> up_to_;
};

const SegmentSights& drawn_view(std::span<const SegmentSights* const> seen, const ObjectLearning& learning,
                                std::int64_t step, std::int64_t number) {
  const RandomAddress of_view{learning.seed, static_cast<std::uint64_t>(step), stream_id("objects/view")};
  return *seen[uniform_below(of_view, static_cast<std::uint64_t>(number), seen.size())];
}

// Views in which any segment is seen.
std::vector<const SegmentSights*> seen_views(std::span<const SegmentSights> sights) {
  std::vector<const SegmentSights*> seen;
  for (const SegmentSights& view : sights)
    if (!view.point.empty()) seen.push_back(&view);
  if (seen.empty())
    throw Error(ErrorKind::data, "objects.segments.none", "no segment lies on a surface that a training view shows",
                "check that the segments belong to these images");
  return seen;
}

// The updates of all steps: Adam at a rate that falls along half a cosine.
std::vector<AdamStep> updates_of(const ObjectLearning& learning) {
  AdamParams adam;
  adam.epsilon = 1e-12;
  ScheduleParams schedule;
  schedule.kind = ScheduleKind::cosine;
  schedule.factor = kEndRate;
  schedule.decay_steps = std::max<std::int64_t>(1, learning.steps);
  std::vector<AdamStep> out;
  for (std::int64_t step = 0; step < learning.steps; ++step)
    out.push_back(adam_step(adam, learning.learning_rate * schedule_factor(schedule, step), step));
  return out;
}

}  // namespace

template <class Real>
ObjectNetwork<Real>::ObjectNetwork(const KernelTables& kernels, const Grouping& grouping,
                                   const ObjectNetworkShape& shape, const Box& box, std::uint64_t seed,
                                   std::int64_t views)
    : kernels_(kernels),
      grouping_(grouping),
      shape_(shape),
      middle_((box.lo + box.hi) * 0.5),
      half_m_(0.5 * std::max({box.size().x, box.size().y, box.size().z, 1e-9})),
      net_(network_of<Real>(kernels, input_dims(), grouping.width(), shape)),
      store_(seed, static_cast<int>(views), true),
      slow_(seed, 1, false),
      component_(store_.add("objects", *net_)),
      slow_component_(slow_.add("objects", *net_)) {
  net_->derive({}, store_.tensors(component_));
  net_->derive({}, slow_.tensors(slow_component_));
}

template <class Real>
void ObjectNetwork<Real>::encode(Vec3d position, Real* row) const {
  const Vec3d at = (position - middle_) * (1 / half_m_);
  for (int axis = 0; axis < 3; ++axis) *row++ = static_cast<Real>(at[axis]);
  double factor = std::numbers::pi / 2;
  for (std::int64_t l = 0; l < shape_.frequencies; ++l, factor *= 2) {
    for (int axis = 0; axis < 3; ++axis) {
      *row++ = static_cast<Real>(std::sin(factor * at[axis]));
      *row++ = static_cast<Real>(std::cos(factor * at[axis]));
    }
  }
}

template <class Real>
std::vector<Real> ObjectNetwork<Real>::encoded(std::span<const Vec3d> positions) {
  std::vector<Real> rows(positions.size() * static_cast<std::size_t>(input_dims()));
  parallel_for((std::ssize(positions) + kBlock - 1) / kBlock, [&](std::int64_t block) {
    for (std::int64_t i = block * kBlock; i < std::min(std::ssize(positions), (block + 1) * kBlock); ++i)
      encode(positions[static_cast<std::size_t>(i)], &rows[static_cast<std::size_t>(i * input_dims())]);
  });
  return rows;
}

template <class Real>
std::vector<Real> ObjectNetwork<Real>::outputs(std::span<const Vec3d> positions) {
  const ComputeFloatMode mode;
  const auto count = static_cast<std::int64_t>(positions.size());
  const std::int32_t width = grouping_.width();
  std::vector<Real> out(static_cast<std::size_t>(count * width));
  arenas_.for_units((count + kBlock - 1) / kBlock, [&](Workspace& arena, std::int64_t block) {
    const Workspace::Scope taken(arena);
    const std::int64_t begin = block * kBlock, rows = std::min(kBlock, count - begin);
    const View<Real> input = arena.take<Real>(rows, input_dims());
    for (std::int64_t r = 0; r < rows; ++r) encode(positions[static_cast<std::size_t>(begin + r)], input.row(r));
    MlpOut<Real> to;
    to.rows = {out.data() + begin * width, rows, width};
    net_->forward(arena, store_.tensors(component_), {input, {}, {}}, {&to, 1}, {});
  });
  return out;
}

template <class Real>
double ObjectNetwork<Real>::view_gradients(View<const Real> points, const SegmentSights& view,
                                           const ObjectLearning& learning, std::int64_t step, std::int64_t number,
                                           Workspace& arena) {
  const SightDraw sights(view, learning.seed, step);
  const std::int64_t count = learning.view_points;
  const std::int32_t width = grouping_.width();
  const Workspace::Scope taken(arena);
  const View<Real> input = arena.take<Real>(count, input_dims()), rows = arena.take<Real>(count, width),
                   gradient = arena.take<Real>(count, width);
  View<Real> slow = rows;
  const View<std::int32_t> segment = arena.take<std::int32_t>(count, 1);
  for (std::int64_t i = 0; i < count; ++i) {
    const std::size_t drawn = sights.draw(static_cast<std::uint64_t>(number * count + i));
    segment(i, 0) = view.segment[drawn];
    std::copy_n(points.row(view.point[drawn]), points.cols, input.row(i));
    std::fill_n(gradient.row(i), width, Real(0));
  }
  const MlpIn<Real> in{input, {}, {}};
  MlpOut<Real> out;
  out.rows = rows;
  const std::size_t bytes = net_->saved_bytes(count);
  const Saved saved(arena.take_bytes(bytes), bytes);
  const Tensors<Real> tensors = store_.tensors(component_, static_cast<int>(number));
  net_->forward(arena, tensors, in, {&out, 1}, saved);
  if (grouping_.slow_share() > 0) {
    slow = arena.take<Real>(count, width);
    MlpOut<Real> slow_out;
    slow_out.rows = slow;
    net_->forward(arena, slow_.tensors(slow_component_), in, {&slow_out, 1}, {});
  }
  const auto all = static_cast<double>(learning.views * count);
  const double loss =
      grouping_.add({rows, slow, {segment.data, static_cast<std::size_t>(count)}, view.segments()}, 1 / all, gradient);
  MlpGrad<Real> back;
  back.rows = gradient;
  net_->backward(arena, tensors, in, {&out, 1}, {&back, 1}, saved, {});
  return loss / all;
}

template <class Real>
double ObjectNetwork<Real>::step_gradients(View<const Real> points, std::span<const SegmentSights* const> seen,
                                           const ObjectLearning& learning, std::int64_t step) {
  std::vector<double> losses(static_cast<std::size_t>(learning.views));
  arenas_.for_units(learning.views, [&](Workspace& arena, std::int64_t v) {
    const SegmentSights& view = drawn_view(seen, learning, step, v);
    losses[static_cast<std::size_t>(v)] = view_gradients(points, view, learning, step, v, arena);
  });
  store_.reduce_lanes();
  net_->derive_backward({}, store_.tensors(component_));
  double sum = 0;
  for (const double loss : losses) sum += loss;
  return sum;
}

template <class Real>
double ObjectNetwork<Real>::gradients(std::span<const Vec3d> positions, std::span<const SegmentSights> sights,
                                      const ObjectLearning& learning, std::int64_t step) {
  const std::vector<const SegmentSights*> seen = seen_views(sights);
  const std::vector<Real> rows = encoded(positions);
  net_->derive({}, store_.tensors(component_));
  store_.clear_gradients();
  return step_gradients({rows.data(), std::ssize(positions), input_dims()}, seen, learning, step);
}

template <class Real>
void ObjectNetwork<Real>::follow(double share) {
  for (std::size_t i = 0; i < store_.all().size(); ++i) {
    const Tensor<Real>& from = store_.all()[i];
    if (!from.learned()) continue;
    Real* const to = slow_.all()[i].value.data();
    for (std::int64_t k = 0; k < from.size(); ++k)
      to[k] = static_cast<Real>(share) * to[k] + static_cast<Real>(1 - share) * from.value.data()[k];
  }
  net_->derive({}, slow_.tensors(slow_component_));
}

template <class Real>
void ObjectNetwork<Real>::learn(std::span<const Vec3d> positions, std::span<const SegmentSights> sights,
                                const ObjectLearning& learning, const ObjectProgress& progress) {
  const ComputeFloatMode mode;
  const std::vector<const SegmentSights*> seen = seen_views(sights);
  const std::vector<Real> rows = encoded(positions);
  const std::vector<AdamStep> updates = updates_of(learning);
  for (std::int64_t step = 0; step < learning.steps; ++step) {
    store_.zero_gradients();
    (void)step_gradients({rows.data(), std::ssize(positions), input_dims()}, seen, learning, step);
    adam_update(&updates[static_cast<std::size_t>(step)], store_.learned());
    net_->derive({}, store_.tensors(component_));
    if (grouping_.slow_share() > 0) follow(grouping_.slow_share());
    if (progress) progress(static_cast<double>(step + 1), static_cast<double>(learning.steps));
  }
}

template <class Real>
bool ObjectNetwork<Real>::learn_on_gpu(int ordinal, std::span<const Vec3d> positions,
                                       std::span<const SegmentSights> sights, const ObjectLearning& learning,
                                       const ObjectProgress& progress) {
  if constexpr (std::is_same_v<Real, float>) {
    const GroupingKernel kernel = grouping_.kernel(Device::cuda, kernels_);
    if (kernel == nullptr) return false;
    const std::vector<const SegmentSights*> seen = seen_views(sights);
    const std::vector<float> rows = encoded(positions);
    const std::vector<AdamStep> updates = updates_of(learning);
    const std::unique_ptr<Mlp<float>> there =
        network_of<float>(kernels_, input_dims(), grouping_.width(), shape_, Device::cuda);
    GroupingLessons lessons{*there, grouping_, kernel, store_, slow_};
    lessons.ordinal = ordinal;
    lessons.points = {rows.data(), std::ssize(positions), input_dims()};
    lessons.updates = updates;
    lessons.images = learning.views;
    lessons.per_image = learning.view_points;
    lessons.draw = [&](std::int64_t step, std::int64_t number, std::span<std::int32_t> point,
                       std::span<std::int32_t> segment) {
      const SegmentSights& view = drawn_view(seen, learning, step, number);
      const SightDraw draw(view, learning.seed, step);
      for (std::int64_t i = 0; i < learning.view_points; ++i) {
        const std::size_t drawn = draw.draw(static_cast<std::uint64_t>(number * learning.view_points + i));
        point[static_cast<std::size_t>(i)] = view.point[drawn];
        segment[static_cast<std::size_t>(i)] = view.segment[drawn];
      }
      return view.segments();
    };
    lessons.progress = progress;
    cuda_library().learn_grouping(lessons);
    net_->derive({}, store_.tensors(component_));
    return true;
  } else {
    return false;
  }
}

template class ObjectNetwork<float>;
template class ObjectNetwork<double>;

}  // namespace semfield
