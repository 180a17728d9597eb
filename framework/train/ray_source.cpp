#include "train/ray_source.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <span>

#include "compute/parallel.h"
#include "core/check.h"
#include "core/error.h"
#include "core/rng.h"

namespace semfield {

static_assert(channel::alpha == kAlphaChannel);

namespace {
// In the order in which rays stand in a tile.
constexpr std::array kRayGroups{RayGroup::label_only, RayGroup::labelled, RayGroup::other};
}  // namespace

std::vector<float>& BatchBuffers::of(std::string_view name) {
  const auto found = std::find_if(more.begin(), more.end(), [&](const Channel& one) { return one.name == name; });
  SEMFIELD_CHECK(found != more.end(), "the batch has no such channel");
  return found->values;
}

RayBatch BatchBuffers::view(bool with_labels) const {
  const auto rays = static_cast<std::int64_t>(label.size());
  RayBatch batch;
  batch.origin = {origin.data(), rays, 3};
  batch.direction = {direction.data(), rays, 3};
  batch.near_far = {near_far.data(), rays, 2};
  batch.targets.color = {target.data(), rays, 3};
  if (with_labels) batch.targets.label = {label.data(), rays, 1};
  for (const Channel& one : more) {
    if (with_labels || one.name != channel::soft_label)
      batch.targets.more.set(one.name, {one.values.data(), rays, one.cols});
  }
  if (!label_only.empty()) batch.label_only = {label_only.data(), std::ssize(label_only), 1};
  batch.tile_rays = tile_rays;
  batch.terms = terms;
  return batch;
}

std::int64_t label_only_rays(double share, std::int64_t begin, std::int64_t end) {
  return static_cast<std::int64_t>(std::floor(static_cast<double>(end) * share)) -
         static_cast<std::int64_t>(std::floor(static_cast<double>(begin) * share));
}

Error no_labelled_pixel() {
  return Error(ErrorKind::data, "labels.training.none",
               "train.ray_source is label_balanced, but no training pixel carries a label",
               "let the labels decide with --set train.ray_source=auto, or give the scene labels");
}

RaySource::RaySource(std::vector<TrainFrame> frames, std::vector<std::int16_t> logit_of_class, const RayLimits& limits,
                     const RaySourceOptions& options)
    : frames_(std::move(frames)), logit_of_class_(std::move(logit_of_class)), limits_(limits), options_(options) {
  SEMFIELD_CHECK(options_.train.ray_source != RaySourceKind::automatic, "a session settles train.ray_source");
  offsets_.push_back(0);
  for (const TrainFrame& frame : frames_) {
    offsets_.push_back(offsets_.back() + std::int64_t{frame.pixels->width_px} * frame.pixels->height_px);
  }
  if (offsets_.back() == 0) {
    throw Error(ErrorKind::data, "scene.split.empty", "the training split has no pixels",
                "check the split rule of 'scene' with `semfield inspect`");
  }
  if (offsets_.back() > std::int64_t{0xFFFFFFFF}) {
    throw Error(ErrorKind::data, "scene.pixels.limit", "the training split has more than 2^32 pixels",
                "reduce it with scene.load.downscale");
  }
  const auto is_masked = [](const TrainFrame& frame) { return !frame.pixels->mask.empty(); };
  if (std::any_of(frames_.begin(), frames_.end(), is_masked)) {
    std::vector<std::int64_t> pixels;
    for (std::size_t f = 0; f < frames_.size(); ++f) pixels.push_back(offsets_[f + 1] - offsets_[f]);
    used_.index(pixels, [this](const Pixel& pixel) { return uses(pixel); });
    for (std::size_t f = 0; f < frames_.size(); ++f)
      SEMFIELD_CHECK(used_.first_of(f) < used_.first_of(f + 1), "a training frame has a pixel that is not masked");
  }
  relabel();
}

void RaySource::relabel() {
  ++version_;
  soft_logits_ = 0;
  const bool soft = std::any_of(frames_.begin(), frames_.end(),
                                [](const TrainFrame& f) { return f.labels != nullptr && !f.labels->soft.empty(); });
  for (const std::int16_t logit : logit_of_class_) {
    if (soft) soft_logits_ = std::max(soft_logits_, static_cast<std::int32_t>(logit) + 1);
  }
  // Soft labels come without being asked for: the cross-entropy reads them. Channels that the source makes itself come
  // first, in the order in which executors draw them too.
  using From = Target::From;
  constexpr std::array kMade{std::pair{channel::depth, From::depth}, std::pair{channel::alpha, From::alpha},
                             std::pair{channel::camera, From::camera}};
  targets_.clear();
  if (soft_logits_ > 0) targets_.push_back({std::string(channel::soft_label), soft_logits_, Target::From::soft_label});
  const std::vector<std::string>& wanted = options_.targets;
  for (const auto& [name, from] : kMade) {
    if (std::find(wanted.begin(), wanted.end(), name) != wanted.end()) targets_.push_back({std::string(name), 1, from});
  }
  for (const std::string& name : wanted) {
    if (name == channel::color || name == channel::label || name == channel::soft_label) continue;
    const auto with = std::find_if(frames_.begin(), frames_.end(),
                                   [&](const TrainFrame& frame) { return frame.pixels->channel(name) != nullptr; });
    const bool made = std::any_of(kMade.begin(), kMade.end(), [&](const auto& one) { return one.first == name; });
    if (!made && with != frames_.end())
      targets_.push_back({name, with->pixels->channel(name)->cols, Target::From::frame});
  }
  if (options_.train.ray_source != RaySourceKind::label_balanced) return;
  index_labels();
  if (!balanced() && !options_.labels_may_come) throw no_labelled_pixel();
}

void RaySource::index_labels() {
  std::vector<std::int64_t> pixels;
  for (std::size_t f = 0; f < frames_.size(); ++f)
    pixels.push_back(frames_[f].labels != nullptr || frames_[f].added != nullptr ? offsets_[f + 1] - offsets_[f] : 0);
  labelled_.index(pixels, [this](const Pixel& pixel) { return label_of(pixel) != kVoid; });
}

bool RaySource::uses(const Pixel& pixel) const {
  return frames_[static_cast<std::size_t>(pixel.frame)].pixels->mask.uses(static_cast<std::size_t>(pixel.index));
}

RaySource::Pixel RaySource::used_pixel(std::uint32_t rank) const {
  return used_.at(rank, [this](const Pixel& pixel) { return uses(pixel); });
}

// Every ray whose running share crosses an integer: spread evenly over the tiles.
bool RaySource::for_its_label(std::int64_t ray) const {
  return balanced() && label_only_rays(options_.train.labelled_share, ray, ray + 1) > 0;
}

RayGroup RaySource::group_of(std::int64_t ray, std::int16_t label) const {
  if (!options_.train.label_rays_teach_color && for_its_label(ray)) return RayGroup::label_only;
  return label != kVoid ? RayGroup::labelled : RayGroup::other;
}

RaySource::Pixel RaySource::choose(std::int64_t step, std::int64_t ray) const {
  const RandomAddress address{options_.seed, static_cast<std::uint64_t>(step), stream_id("ray_source/pixel")};
  const auto index = static_cast<std::uint64_t>(ray);
  switch (options_.train.ray_source) {
    case RaySourceKind::one_image: {
      const RandomAddress frame_address{options_.seed, static_cast<std::uint64_t>(step), stream_id("ray_source/frame")};
      const auto frame = static_cast<std::int32_t>(uniform_below(frame_address, 0, frames_.size()));
      const auto f = static_cast<std::size_t>(frame);
      if (used_.count() > 0) {
        const std::uint32_t first = used_.first_of(f);
        return used_pixel(first +
                          static_cast<std::uint32_t>(uniform_below(address, index, used_.first_of(f + 1) - first)));
      }
      const std::int64_t pixels = offsets_[f + 1] - offsets_[f];
      return {frame, static_cast<std::int32_t>(uniform_below(address, index, static_cast<std::uint64_t>(pixels)))};
    }
    case RaySourceKind::label_balanced: {
      if (for_its_label(ray)) {
        return labelled_.at(static_cast<std::uint32_t>(uniform_below(address, index, labelled_.count())),
                            [this](const Pixel& pixel) { return label_of(pixel) != kVoid; });
      }
      break;
    }
    case RaySourceKind::all_images:
    case RaySourceKind::automatic:
      break;
  }
  if (used_.count() > 0) return used_pixel(static_cast<std::uint32_t>(uniform_below(address, index, used_.count())));
  const auto global =
      static_cast<std::int64_t>(uniform_below(address, index, static_cast<std::uint64_t>(offsets_.back())));
  const auto after = std::upper_bound(offsets_.begin(), offsets_.end(), global);
  const auto frame = static_cast<std::int32_t>(after - offsets_.begin() - 1);
  return {frame, static_cast<std::int32_t>(global - offsets_[static_cast<std::size_t>(frame)])};
}

void RaySource::add_labels(const std::vector<LabelMap>& labels) {
  ++version_;
  SEMFIELD_CHECK(labels.size() == frames_.size(), "a map of labels per frame");
  for (std::size_t f = 0; f < frames_.size(); ++f) frames_[f].added = labels[f].empty() ? nullptr : &labels[f];
  if (options_.train.ray_source == RaySourceKind::label_balanced) index_labels();
}

std::optional<PixelPool> RaySource::pool() const {
  PixelPool pool;
  for (const Target& target : targets_) {
    if (target.from == Target::From::soft_label || target.from == Target::From::frame) return std::nullopt;
    pool.with_depth |= target.from == Target::From::depth;
    pool.with_alpha |= target.from == Target::From::alpha;
    pool.with_camera |= target.from == Target::From::camera;
  }
  for (const TrainFrame& f : frames_) {
    const bool labelled = !logit_of_class_.empty() && (f.labels != nullptr || f.added != nullptr);
    pool.frames.push_back({f.camera.camera, f.camera.world_from_camera, f.camera.undistort, f.pixels, labelled});
  }
  pool.offsets = offsets_;
  pool.limits = limits_;
  pool.seed = options_.seed;
  pool.rays = options_.train.rays;
  pool.tile_rays = std::min(options_.tile_rays, options_.train.rays);
  if (options_.train.ray_source == RaySourceKind::one_image) pool.choice = PixelChoice::one_image;
  if (options_.train.ray_source == RaySourceKind::label_balanced && balanced()) {
    pool.choice = PixelChoice::label_balanced;
    pool.labelled_share = options_.train.labelled_share;
    pool.labels_apart = !options_.train.label_rays_teach_color;
    for (std::int64_t begin = 0; pool.labels_apart && begin < pool.rays; begin += pool.tile_rays)
      pool.label_only.push_back(
          label_only_rays(pool.labelled_share, begin, std::min(begin + pool.tile_rays, pool.rays)));
    pool.block = PixelRanks::kBlock;
    pool.block_offsets = labelled_.block_offsets;
    pool.ranks_before = labelled_.before;
  }
  pool.used_block_offsets = used_.block_offsets;
  pool.used_before = used_.before;
  pool.with_labels = !logit_of_class_.empty();
  pool.read_labels = [this](std::size_t frame, std::span<std::int16_t> logit) {
    constexpr std::int64_t kPart = 16384;
    const std::int64_t pixels = std::ssize(logit);
    parallel_for((pixels + kPart - 1) / kPart, [&](std::int64_t part) {
      for (std::int64_t p = part * kPart; p < std::min(pixels, (part + 1) * kPart); ++p)
        logit[static_cast<std::size_t>(p)] = label_of({static_cast<std::int32_t>(frame), static_cast<std::int32_t>(p)});
    });
  };
  return pool;
}

std::int16_t RaySource::label_of(const Pixel& pixel) const {
  if (!uses(pixel)) return kVoid;
  const TrainFrame& frame = frames_[static_cast<std::size_t>(pixel.frame)];
  const auto index = static_cast<std::size_t>(pixel.index);
  std::int16_t cls = frame.labels == nullptr || frame.labels->empty() ? kVoid : (*frame.labels)[index];
  if (cls == kVoid && frame.added != nullptr) cls = (*frame.added)[index];
  if (cls == kVoid || logit_of_class_.empty()) return kVoid;
  if (cls < 0 || static_cast<std::size_t>(cls) >= logit_of_class_.size()) {
    throw Error(ErrorKind::data, "labels.class.range",
                fmt::format("{}: label {} is not a class; classes are 0 to {} and void is {}", place_of(pixel), cls,
                            logit_of_class_.size() - 1, kVoid),
                "check the labels against the scene's class table");
  }
  return logit_of_class_[static_cast<std::size_t>(cls)];
}

std::string RaySource::place_of(const Pixel& pixel) const {
  const TrainFrame& frame = frames_[static_cast<std::size_t>(pixel.frame)];
  const std::int32_t width = frame.pixels->width_px;
  return fmt::format("frame '{}', pixel x {}, y {}", frame.name, pixel.index % width, pixel.index / width);
}

std::string RaySource::place_of_row(std::int64_t step, std::int64_t row) const {
  const std::int64_t begin = row / options_.tile_rays * options_.tile_rays;
  const std::int64_t end = std::min(begin + options_.tile_rays, options_.train.rays);
  std::int64_t slot = begin;
  for (const RayGroup group : kRayGroups) {
    for (std::int64_t ray = begin; ray < end; ++ray) {
      const Pixel pixel = choose(step, ray);
      if (group_of(ray, label_of(pixel)) == group && slot++ == row) return place_of(pixel);
    }
  }
  return {};
}

void RaySource::soft_label_of(const Pixel& pixel, std::span<float> out) const {
  std::fill(out.begin(), out.end(), 0.0F);
  const std::int16_t label = label_of(pixel);
  if (label == kVoid) return;
  const TrainingLabels::Frame* labels = frames_[static_cast<std::size_t>(pixel.frame)].labels;
  const auto index = static_cast<std::size_t>(pixel.index);
  if (labels == nullptr || labels->soft.empty() || !labels->soft.labelled(index)) {  // hard, or added
    out[static_cast<std::size_t>(label)] = 1;
    return;
  }
  for (std::size_t c = 0; c < logit_of_class_.size(); ++c) {
    if (logit_of_class_[c] == kVoid) continue;
    out[static_cast<std::size_t>(logit_of_class_[c])] = labels->soft.at(index, static_cast<int>(c));
  }
}

// Metres along the ray; 0 where the image has none, where the ray does not reach it, and of rays that are there for
// their labels alone, which do not shape geometry.
float RaySource::depth_of(const BatchBuffers::Choice& choice, double cosine, const double* near_far) const {
  const DepthMap& depth_m = frames_[static_cast<std::size_t>(choice.pixel.frame)].pixels->depth_m;
  if (depth_m.empty() || cosine <= 0 || choice.group == RayGroup::label_only) return 0;
  const double t = static_cast<double>(depth_m[static_cast<std::size_t>(choice.pixel.index)]) / cosine;
  return t > near_far[0] && t < near_far[1] ? static_cast<float>(t) : 0.0F;
}

void RaySource::write_row(const BatchBuffers::Choice& choice, BatchBuffers& batch) const {
  const TrainFrame& frame = frames_[static_cast<std::size_t>(choice.pixel.frame)];
  const std::int32_t width = frame.pixels->width_px, index = choice.pixel.index;
  const auto s = static_cast<std::size_t>(choice.row);
  const double cosine = cast_ray(frame.camera, limits_, index % width, index / width, &batch.origin[3 * s],
                                 &batch.direction[3 * s], &batch.near_far[2 * s]);
  for (std::size_t i = 0; i < 3; ++i) {
    batch.target[3 * s + i] = static_cast<float>(frame.pixels->rgb[3 * static_cast<std::size_t>(index) + i]) / 255.0F;
  }
  batch.label[s] = choice.label;
  for (std::size_t i = 0; i < targets_.size(); ++i) {
    const auto cols = static_cast<std::size_t>(targets_[i].cols);
    const std::span<float> out = std::span(batch.more[i].values).subspan(s * cols, cols);
    switch (targets_[i].from) {
      case Target::From::soft_label:
        soft_label_of(choice.pixel, out);
        break;
      case Target::From::depth:
        out[0] = depth_of(choice, cosine, &batch.near_far[2 * s]);
        break;
      case Target::From::alpha:
        // Unknown where the frame has none, and of rays that are there for their labels alone.
        out[0] = frame.pixels->alpha.empty() || choice.group == RayGroup::label_only
                     ? -1
                     : static_cast<float>(frame.pixels->alpha[static_cast<std::size_t>(index)]) / 255.0F;
        break;
      case Target::From::camera:
        out[0] = static_cast<float>(choice.pixel.frame);
        break;
      case Target::From::frame:
        frame.pixels->read_channel(targets_[i].name, index, out);
        break;
    }
  }
}

void RaySource::fill(std::int64_t step, BatchBuffers& batch) const {
  const auto n = static_cast<std::size_t>(options_.train.rays);
  batch.origin.resize(3 * n);
  batch.direction.resize(3 * n);
  batch.near_far.resize(2 * n);
  batch.target.resize(3 * n);
  batch.label.resize(n);
  batch.choices.resize(n);
  batch.more.resize(targets_.size());
  for (std::size_t i = 0; i < targets_.size(); ++i) {
    batch.more[i].name = targets_[i].name;
    batch.more[i].cols = targets_[i].cols;
    batch.more[i].values.resize(n * static_cast<std::size_t>(targets_[i].cols));
  }
  // Pieces of the batch, so that a tile that is all of it occupies every thread too.
  const auto in_pieces = [&](const auto& body) {
    constexpr std::int64_t kPiece = 256;
    parallel_for((options_.train.rays + kPiece - 1) / kPiece, [&](std::int64_t piece) {
      const std::int64_t end = std::min((piece + 1) * kPiece, options_.train.rays);
      for (std::int64_t ray = piece * kPiece; ray < end; ++ray) body(ray, batch.choices[static_cast<std::size_t>(ray)]);
    });
  };
  in_pieces([&](std::int64_t ray, BatchBuffers::Choice& choice) {
    choice.pixel = choose(step, ray);
    choice.label = label_of(choice.pixel);
    choice.group = group_of(ray, choice.label);
  });
  const bool apart = balanced() && !options_.train.label_rays_teach_color;
  batch.label_only.clear();
  batch.tile_rays = std::min(options_.tile_rays, options_.train.rays);
  for (std::int64_t begin = 0; begin < options_.train.rays; begin += batch.tile_rays) {
    const std::int64_t count = std::min(batch.tile_rays, options_.train.rays - begin);
    const auto tile =
        std::span(batch.choices).subspan(static_cast<std::size_t>(begin), static_cast<std::size_t>(count));
    std::int64_t row = begin;
    for (const RayGroup group : kRayGroups) {
      for (BatchBuffers::Choice& choice : tile)
        if (choice.group == group) choice.row = row++;
      if (apart && group == RayGroup::label_only) batch.label_only.push_back(row - begin);
    }
  }
  in_pieces([&](std::int64_t, const BatchBuffers::Choice& choice) { write_row(choice, batch); });
}

}  // namespace semfield
