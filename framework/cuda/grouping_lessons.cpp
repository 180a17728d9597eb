// Learning a grouping on the device.
#include <algorithm>

#include "compute/parallel.h"
#include "core/non_copyable.h"
#include "cuda/kernels/kernels.h"
#include "cuda/launch.h"
#include "cuda/matmul.h"
#include "cuda/store.h"

namespace semfield::cuda {

namespace {

constexpr std::int64_t kDrawsAtOnce = std::int64_t{1} << 21;  // 16 MB

class Stream : NonCopyable {
 public:
  Stream() { check(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking), "making a stream"); }
  ~Stream() {
    forget_stream(stream_);
    (void)cudaStreamDestroy(stream_);
  }
  cudaStream_t get() const { return stream_; }

 private:
  cudaStream_t stream_ = nullptr;
};

// Points of many steps on the host.
struct Draws {
  std::vector<std::int32_t> point, segment, segments;

  Draws(const GroupingLessons& lessons, std::int64_t first, std::int64_t count) {
    const std::int64_t images = count * lessons.images;
    point.resize(static_cast<std::size_t>(images * lessons.per_image));
    segment.resize(point.size());
    segments.resize(static_cast<std::size_t>(images));
    const auto per_image = static_cast<std::size_t>(lessons.per_image);
    parallel_for(images, [&](std::int64_t i) {
      const auto n = static_cast<std::size_t>(i);
      segments[n] = lessons.draw(first + i / lessons.images, i % lessons.images,
                                 std::span(point).subspan(n * per_image, per_image),
                                 std::span(segment).subspan(n * per_image, per_image));
    });
  }
};

// What lies on the device while the lessons go on.
class Lesson {
 public:
  explicit Lesson(const GroupingLessons& lessons)
      : lessons_(lessons),
        net_(lessons.network),
        store_(lessons.store, true),
        slow_(lessons.slow, false),
        points_(static_cast<std::size_t>(lessons.points.size()), "points to learn from"),
        cells_(lessons.updates.size(), "steps of learning a grouping"),
        at_once_(std::max<std::int64_t>(1, kDrawsAtOnce / (lessons.images * lessons.per_image))) {
    component_ = store_.add("objects", net_);
    slow_component_ = slow_.add("objects", net_);
    store_.upload();
    slow_.upload();
    upload<float>({lessons.points.data, points_.size()}, points_.data());
    std::vector<StepCell> cells(lessons.updates.size());
    for (std::size_t n = 0; n < cells.size(); ++n) cells[n].adam = lessons.updates[n];
    upload<StepCell>(cells, cells_.data());
    const auto draws = static_cast<std::size_t>(at_once_ * lessons.images * lessons.per_image);
    point_ = Buffer<std::int32_t>(draws, "points of steps");
    segment_ = Buffer<std::int32_t>(draws, "segments of steps");
    segments_ = Buffer<std::int32_t>(static_cast<std::size_t>(at_once_ * lessons.images), "segments of images");
    net_.derive({}, slow_.tensors(slow_component_));
  }

  void learn() {
    const auto steps = static_cast<std::int64_t>(lessons_.updates.size());
    for (std::int64_t first = 0; first < steps; first += at_once_) {
      const std::int64_t count = std::min(at_once_, steps - first);
      const Draws draws(lessons_, first, count);
      synchronize();  // the steps before have read theirs
      upload<std::int32_t>(draws.point, point_.data());
      upload<std::int32_t>(draws.segment, segment_.data());
      upload<std::int32_t>(draws.segments, segments_.data());
      most_segments_ = *std::max_element(draws.segments.begin(), draws.segments.end());
      for (std::int64_t k = 0; k < count; ++k) step(first + k, k);
      if (lessons_.progress) lessons_.progress(static_cast<double>(first + count), static_cast<double>(steps));
    }
    store_.download();
    slow_.download();
  }

 private:
  void step(std::int64_t number, std::int64_t place) {
    const Workspace::Scope taken(arena_);
    const std::int64_t rows = lessons_.images * lessons_.per_image;
    const std::int32_t inputs = lessons_.points.cols, width = lessons_.grouping.width();
    const Tensors<float> tensors = store_.tensors(component_);
    net_.derive({}, tensors);
    store_.zero_derived_gradients();
    const View<float> input = arena_.take<float>(rows, inputs), out = arena_.take<float>(rows, width),
                      gradient = arena_.take<float>(rows, width);
    gather_rows(points_.view(lessons_.points.rows, inputs),
                View<const std::int32_t>(point_.data() + place * rows, rows, 1, 1, Device::cuda), input);
    const MlpIn<float> in{input, {}, {}};
    MlpOut<float> to;
    to.rows = out;
    const std::size_t bytes = net_.saved_bytes(rows);
    const Saved saved(arena_.take_bytes(bytes), bytes);
    net_.forward(arena_, tensors, in, {&to, 1}, saved);
    GroupingCall call;
    call.rows = call.slow = out;
    if (lessons_.grouping.slow_share() > 0) {
      const View<float> slow = arena_.take<float>(rows, width);
      MlpOut<float> slow_to;
      slow_to.rows = slow;
      net_.forward(arena_, slow_.tensors(slow_component_), in, {&slow_to, 1}, {});
      call.slow = slow;
    }
    call.segment = View<const std::int32_t>(segment_.data() + place * rows, rows, 1, 1, Device::cuda);
    call.segments =
        View<const std::int32_t>(segments_.data() + place * lessons_.images, lessons_.images, 1, 1, Device::cuda);
    call.per_image = lessons_.per_image;
    call.most_segments = most_segments_;
    call.scale = 1 / static_cast<double>(rows);
    call.gradients = gradient;
    fill(gradient, 0.0F);
    lessons_.kernel(lessons_.grouping, call, arena_);
    MlpGrad<float> back;
    back.rows = gradient;
    net_.backward(arena_, tensors, in, {&to, 1}, {&back, 1}, saved, {});
    net_.derive_backward({}, tensors);
    adam_update(&cells_.data()[number].adam, store_.learned());
    if (lessons_.grouping.slow_share() > 0) {
      follow(store_.values(), slow_.values(), lessons_.grouping.slow_share());
      net_.derive({}, slow_.tensors(slow_component_));
    }
  }

  const GroupingLessons& lessons_;
  const Mlp<float>& net_;
  Store store_, slow_;
  int component_ = 0, slow_component_ = 0;
  Buffer<float> points_;
  Buffer<StepCell> cells_;
  std::int64_t at_once_;
  Buffer<std::int32_t> point_, segment_, segments_;
  std::int32_t most_segments_ = 0;
  Workspace arena_{arena_source()};
};

}  // namespace

void learn_grouping(const GroupingLessons& lessons) {
  Launch here;
  here.ordinal = lessons.ordinal;
  here.deterministic = true;
  const LaunchScope on_device(here);
  const Stream stream;
  here.stream = stream.get();
  const LaunchScope scope(here);
  Lesson lesson(lessons);
  lesson.learn();
}

}  // namespace semfield::cuda
