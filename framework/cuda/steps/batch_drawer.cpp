#include "cuda/steps/batch_drawer.h"

#include <algorithm>
#include <bit>
#include <cstring>

#include "compute/parallel.h"
#include "core/check.h"

namespace semfield::cuda {

namespace {

static_assert(kVoid == kNoLabel);

std::int64_t pixels_of(const PixelPool::Frame& frame) {
  return std::int64_t{frame.pixels->width_px} * frame.pixels->height_px;
}
bool bends(const PixelPool::Frame& frame) { return frame.undistort && frame.camera.has_distortion(); }

// Frames with lenses of their own: the first of those that share one.
std::vector<std::size_t> lenses_of(const PixelPool& pool) {
  std::vector<std::size_t> first;
  for (std::size_t f = 0; f < pool.frames.size(); ++f) {
    const auto known = [&](std::size_t g) { return pool.frames[g].camera == pool.frames[f].camera; };
    if (bends(pool.frames[f]) && std::none_of(first.begin(), first.end(), known)) first.push_back(f);
  }
  return first;
}

// A batch in host memory, or one without data: that of labels, or null. Channels stand in RaySource's order.
RayBatch batch_with(const PixelPool& pool, const std::int16_t* label) {
  RayBatch batch;
  batch.origin = {nullptr, pool.rays, 3};
  batch.direction = {nullptr, pool.rays, 3};
  batch.near_far = {nullptr, pool.rays, 2};
  batch.targets.color = {nullptr, pool.rays, 3};
  if (pool.with_labels) batch.targets.label = {label, pool.rays, 1};
  if (pool.with_depth) batch.targets.more.set(channel::depth, {nullptr, pool.rays, 1});
  if (pool.with_alpha) batch.targets.more.set(channel::alpha, {nullptr, pool.rays, 1});
  if (pool.with_camera) batch.targets.more.set(channel::camera, {nullptr, pool.rays, 1});
  if (!pool.label_only.empty()) batch.label_only = {pool.label_only.data(), std::ssize(pool.label_only), 1};
  batch.tile_rays = pool.tile_rays;
  return batch;
}
BatchLayout layout_of(const PixelPool& pool) {
  static const std::int16_t some_label = 0;  // labels are there where their view is not empty
  return BatchLayout(batch_with(pool, &some_label));
}

template <class T>
Buffer<T> held(std::span<const T> values, const char* what) {
  Buffer<T> memory(values.size(), what);
  upload<T>(values, memory.data());
  return memory;
}

constexpr std::int64_t kLeast = 8192;  // fewer rows make no step faster
constexpr double kSpare = 1.25, kTight = 1.06;
constexpr double kWorth = 0.75;  // of the room before: each change costs two steps without a graph

// Up to 16 sizes an octave, so that few graphs are made.
std::int64_t rounded_up(std::int64_t rows) {
  const int bits = std::bit_width(static_cast<std::uint64_t>(rows));
  const std::int64_t unit = std::int64_t{1} << std::max(0, bits - 4);
  return (rows + unit - 1) / unit * unit;
}

}  // namespace

std::size_t BatchDrawer::bytes_of(const PixelPool& pool, int ahead) {
  std::size_t per_pixel = 3, bytes = 0;
  if (pool.with_labels) per_pixel += sizeof(std::int16_t);
  if (pool.with_depth) per_pixel += sizeof(float);
  if (pool.with_alpha) per_pixel += 1;
  for (const std::size_t f : lenses_of(pool))
    bytes += static_cast<std::size_t>(pixels_of(pool.frames[f])) * 3 * sizeof(double);
  bytes += pool.used_before.size() * (sizeof(std::uint64_t) + sizeof(std::uint32_t));
  const std::size_t of_step = layout_of(pool).bytes() + static_cast<std::size_t>(pool.rays) * sizeof(DrawnRay);
  return bytes + per_pixel * static_cast<std::size_t>(pool.offsets.back()) + of_step * static_cast<std::size_t>(ahead);
}

BatchDrawer::BatchDrawer(const PixelPool& pool, int ahead)
    : with_labels_(pool.with_labels),
      with_depth_(pool.with_depth),
      with_alpha_(pool.with_alpha),
      with_camera_(pool.with_camera),
      layout_(layout_of(pool)),
      ahead_(ahead) {
  const auto steps = static_cast<std::size_t>(ahead), rays = static_cast<std::size_t>(pool.rays);
  scratch_ = Buffer<DrawnRay>(steps * rays, "rays of steps");
  batches_ = Buffer<std::byte>(steps * layout_.bytes(), "batches of steps");
  send_pixels(pool);
  send_labels(pool);
  if (with_labels_) seen_label_ = pinned<std::int16_t>(steps * rays, "pinned memory of labels");
  if (with_depth_) seen_depth_ = pinned<float>(steps * rays, "pinned memory of depth");
  if (with_alpha_) seen_alpha_ = pinned<float>(steps * rays, "pinned memory of alpha");
  synchronize();
}

void BatchDrawer::send_pixels(const PixelPool& pool) {
  const auto pixels = static_cast<std::size_t>(pool.offsets.back());
  rgb_ = Buffer<std::uint8_t>(3 * pixels, "colours of pixels");
  if (pool.with_depth) depth_ = Buffer<float>(pixels, "depth of pixels");
  if (pool.with_alpha) alpha_ = Buffer<std::uint8_t>(pixels, "alpha of pixels");
  if (pool.with_labels) label_ = Buffer<std::int16_t>(pixels, "labels of pixels");
  std::vector<HeldFrame> frames;
  for (std::size_t f = 0; f < pool.frames.size(); ++f) {
    const PixelPool::Frame& frame = pool.frames[f];
    const auto first = static_cast<std::size_t>(pool.offsets[f]);
    HeldFrame& there = frames.emplace_back();
    there.fx = frame.camera.fx;
    there.fy = frame.camera.fy;
    there.cx = frame.camera.cx;
    there.cy = frame.camera.cy;
    there.world_from_camera = frame.world_from_camera;
    there.width_px = frame.pixels->width_px;
    there.lens = {frame.camera.has_finite_lens(), frame.camera.is_wide()};
    upload<std::uint8_t>(frame.pixels->rgb, rgb_.data() + 3 * first);
    if (pool.with_depth && !frame.pixels->depth_m.empty()) {
      const std::vector<float> depth = frame.pixels->depth_m.expand();
      upload<float>(depth, depth_.data() + first);
      synchronize();
    }
    if (pool.with_alpha && !frame.pixels->alpha.empty()) {
      there.has_alpha = true;
      upload<std::uint8_t>(frame.pixels->alpha, alpha_.data() + first);
    }
    frames_.push_back(frame.pixels);
  }
  send_lenses(pool, frames);
  send_masks(pool);
  frame_table_ = held<HeldFrame>(frames, "cameras of frames");
  offsets_ = held<std::int64_t>(pool.offsets, "pixels of frames");
  held_.frames = frame_table_.data();
  held_.offsets = offsets_.data();
  held_.frame_count = static_cast<std::int32_t>(frames.size());
  held_.rgb = rgb_.data();
  held_.label = label_.data();
  held_.depth_m = depth_.data();
  held_.alpha = alpha_.data();
  synchronize();
}

void BatchDrawer::send_masks(const PixelPool& pool) {
  if (pool.used_before.empty()) return;
  std::vector<std::uint64_t> words;
  for (const PixelPool::Frame& frame : pool.frames) {
    const std::span<const std::uint64_t> own = frame.pixels->mask.words();
    words.insert(words.end(), own.begin(), own.end());
    if (!own.empty()) continue;
    const std::int64_t pixels = pixels_of(frame), left = pixels % PixelMask::kWordPixels;
    words.insert(words.end(), static_cast<std::size_t>(pixels / PixelMask::kWordPixels), ~std::uint64_t{0});
    if (left > 0) words.push_back((std::uint64_t{1} << left) - 1);
  }
  const std::vector<std::int64_t> blocks(pool.used_block_offsets.begin(), pool.used_block_offsets.end());
  used_words_ = held<std::uint64_t>(words, "masks of frames");
  used_block_offsets_ = held<std::int64_t>(blocks, "blocks of masks");
  used_before_ = held<std::uint32_t>(pool.used_before, "ranks of pixels");
  synchronize();
  held_.used_words = used_words_.data();
  held_.used_block_offsets = used_block_offsets_.data();
  held_.used_before = used_before_.data();
  held_.used_blocks = std::ssize(words);
}

// Newton's method is the host's: its last bits follow the library's hypot.
void BatchDrawer::send_lenses(const PixelPool& pool, std::vector<HeldFrame>& frames) {
  for (const std::size_t first : lenses_of(pool)) {
    const PixelPool::Frame& frame = pool.frames[first];
    const std::int64_t width = frame.pixels->width_px;
    std::vector<double> direction(3 * static_cast<std::size_t>(pixels_of(frame)));
    parallel_for(frame.pixels->height_px, [&](std::int64_t row) {
      for (std::int64_t column = 0; column < width; ++column) {
        const Vec3d d = frame.camera.direction(static_cast<double>(column) + 0.5, static_cast<double>(row) + 0.5);
        for (int i = 0; i < 3; ++i) direction[static_cast<std::size_t>(3 * (row * width + column) + i)] = d[i];
      }
    });
    const Buffer<double>& there = directions_.emplace_back(direction.size(), "directions of a lens");
    upload<double>(direction, there.data());
    synchronize();
    for (std::size_t f = first; f < frames.size(); ++f) {
      if (bends(pool.frames[f]) && pool.frames[f].camera == frame.camera) frames[f].direction = there.data();
    }
  }
}

void BatchDrawer::send_labels(const PixelPool& pool) {
  any_ = false;
  rule_ = pool;
  layout_ = layout_of(pool);
  const bool fresh = labelled_.empty();
  labelled_.resize(pool.frames.size());
  std::vector<std::int16_t> labels;
  for (std::size_t f = 0; f < pool.frames.size() && pool.with_labels; ++f) {
    const bool had = labelled_[f], has = pool.frames[f].has_labels;
    labelled_[f] = has;
    if (!fresh && !had && !has) continue;
    labels.assign(static_cast<std::size_t>(pixels_of(pool.frames[f])), kNoLabel);
    if (has) pool.read_labels(f, labels);
    upload<std::int16_t>(labels, label_.data() + pool.offsets[f]);
    synchronize();
  }
  if (pool.choice != PixelChoice::label_balanced) return;
  const std::vector<std::int64_t> blocks(pool.block_offsets.begin(), pool.block_offsets.end());
  block_offsets_ = held<std::int64_t>(blocks, "blocks of labels");
  ranks_ = held<std::uint32_t>(pool.ranks_before, "ranks of labels");
  synchronize();
  held_.block_offsets = block_offsets_.data();
  held_.ranks_before = ranks_.data();
  held_.blocks = std::ssize(pool.ranks_before) - 1;
}

bool BatchDrawer::relabel(const PixelPool& pool) {
  if (pool.rays != rule_.rays || pool.tile_rays != rule_.tile_rays || pool.frames.size() != frames_.size() ||
      pool.with_labels != with_labels_ || pool.with_depth != with_depth_ || pool.with_alpha != with_alpha_ ||
      pool.with_camera != with_camera_)
    return false;
  for (std::size_t f = 0; f < frames_.size(); ++f)
    if (pool.frames[f].pixels != frames_[f]) return false;
  send_labels(pool);
  return true;
}

void BatchDrawer::draw(std::int64_t step) {
  if (any_ && step >= first_ && step < first_ + ahead_) return;
  const RayBatch first = layout_.in(batches_.data(), Device::cuda);
  const ChannelTable<const float>& more = first.targets.more;
  DrawnBatches batches;
  batches.origin = const_cast<double*>(first.origin.data);
  batches.direction = const_cast<double*>(first.direction.data);
  batches.near_far = const_cast<double*>(first.near_far.data);
  batches.target = const_cast<float*>(first.targets.color.data);
  batches.label = const_cast<std::int16_t*>(first.targets.label.data);
  batches.depth = const_cast<float*>(more[channel::depth].data);
  batches.alpha = const_cast<float*>(more[channel::alpha].data);
  batches.camera = const_cast<float*>(more[channel::camera].data);
  batches.stride = static_cast<std::int64_t>(layout_.bytes());
  draw_rays(held_, rule_, step, ahead_, scratch_.data(), batches);
  const auto fetch = [&](void* to, const void* from, std::size_t bytes) {
    check(cudaMemcpy2DAsync(to, bytes, from, layout_.bytes(), bytes, static_cast<std::size_t>(ahead_),
                            cudaMemcpyDeviceToHost, launch().stream),
          "fetching labels");
  };
  const auto rays = static_cast<std::size_t>(rule_.rays);
  if (with_labels_) fetch(seen_label_.get(), batches.label, rays * sizeof(std::int16_t));
  if (with_depth_) fetch(seen_depth_.get(), batches.depth, rays * sizeof(float));
  if (with_alpha_) fetch(seen_alpha_.get(), batches.alpha, rays * sizeof(float));
  synchronize();
  first_ = step;
  any_ = true;
}

const std::byte* BatchDrawer::batch(std::int64_t step) const {
  SEMFIELD_CHECK(any_ && step >= first_ && step < first_ + ahead_, "a step that was drawn");
  return batches_.data() + static_cast<std::size_t>(step - first_) * layout_.bytes();
}

RayBatch BatchDrawer::seen(std::int64_t step) const {
  SEMFIELD_CHECK(any_ && step >= first_ && step < first_ + ahead_, "a step that was drawn");
  const std::size_t at = static_cast<std::size_t>(step - first_) * static_cast<std::size_t>(rule_.rays);
  RayBatch batch = layout_.in(nullptr, Device::cuda);
  each_array(batch, [](auto& view) { view.data = nullptr, view.device = Device::cpu; });
  if (with_labels_) batch.targets.label.data = seen_label_.get() + at;
  if (with_depth_) batch.targets.more.set(channel::depth, {seen_depth_.get() + at, rule_.rays, 1});
  if (with_alpha_) batch.targets.more.set(channel::alpha, {seen_alpha_.get() + at, rule_.rays, 1});
  if (with_camera_) batch.targets.more.set(channel::camera, {nullptr, rule_.rays, 1});
  return batch;
}

Staging::Staging(int slots, const RayBatch& like) : layout_(like) {
  const std::size_t bytes = kCellBytes + layout_.bytes();
  host_ = pinned<std::byte>(static_cast<std::size_t>(slots) * bytes, "pinned memory of batches");
  host_sums_ = pinned<StepSums>(static_cast<std::size_t>(slots), "pinned memory of sums");
  device_ = Buffer<std::byte>(bytes, "batch of rays");
  device_sums_ = Buffer<StepSums>(1, "sums of a step");
  check(cudaMemsetAsync(device_sums_.data(), 0xFF, sizeof(FaultKey), launch().stream), "resetting a fault");
}

void Staging::send(int slot, const StepCell& cell, const RayBatch& batch) {
  std::memcpy(slot_at(slot), &cell, sizeof cell);
  layout_.write(batch, slot_at(slot) + kCellBytes);
  send_again(slot, nullptr);
}

void Staging::send(int slot, const StepCell& cell, const std::byte* drawn) {
  std::memcpy(slot_at(slot), &cell, sizeof cell);
  send_again(slot, drawn);
}

void Staging::send_again(int slot, const std::byte* drawn) {
  const std::size_t from_host = drawn == nullptr ? kCellBytes + layout_.bytes() : kCellBytes;
  check(cudaMemcpyAsync(device_.data(), slot_at(slot), from_host, cudaMemcpyHostToDevice, launch().stream),
        "sending a batch");
  if (drawn == nullptr) return;
  check(cudaMemcpyAsync(device_.data() + kCellBytes, drawn, layout_.bytes(), cudaMemcpyDeviceToDevice, launch().stream),
        "copying a batch");
}

void Staging::fetch(int slot) {
  check(cudaMemcpyAsync(&host_sums_[slot], device_sums_.data(), sizeof(StepSums), cudaMemcpyDeviceToHost,
                        launch().stream),
        "fetching sums");
}

bool SampleRoom::saw(std::int64_t samples) {
  if (most_ == 0) return false;
  const std::int64_t now = rows_ == 0 ? most_ : rows_;
  const double used = static_cast<double>(samples);
  std::int64_t wanted = std::max(kLeast, rounded_up(static_cast<std::int64_t>(used * kSpare)));
  if (static_cast<double>(wanted) > kWorth * static_cast<double>(most_)) wanted = most_;
  const bool tight = used * kTight > static_cast<double>(now);
  if (wanted == now || (!tight && static_cast<double>(wanted) > kWorth * static_cast<double>(now))) return false;
  rows_ = wanted == most_ ? 0 : wanted;
  return true;
}

}  // namespace semfield::cuda
