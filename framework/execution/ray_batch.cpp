#include "execution/ray_batch.h"

#include <algorithm>
#include <cstring>

#include "core/check.h"

namespace semfield {

RayBatch RayBatch::rows(std::int64_t begin, std::int64_t count) const {
  RayBatch out = *this;
  each_array(out, [&](auto& view) {
    if (!view.empty()) view = view.row_range(begin, count);
  });
  if (label_only.empty()) return out;
  const std::int64_t at = skipped + begin, tile = at / tile_rays;
  out.label_only = label_only.row_range(tile, (at + count + tile_rays - 1) / tile_rays - tile);
  out.skipped = at - tile * tile_rays;
  return out;
}

std::int64_t RayBatch::without_color() const {
  if (label_only.empty() || label_only.rows == 0) return 0;
  return std::clamp<std::int64_t>(label_only(0, 0) - skipped, 0, origin.rows);
}

RayBatch BatchShape::batch() const {
  RayBatch out;
  const auto there = [&](auto& view, std::int32_t cols) {
    view.rows = rays;
    view.cols = cols;
    view.row_stride = cols;
  };
  there(out.origin, 3);
  there(out.direction, 3);
  there(out.near_far, 2);
  there(out.targets.color, 3);
  if (labels) there(out.targets.label, 1);
  for (std::int32_t i = 0; i < channels; ++i) {
    const Channel& one = more[static_cast<std::size_t>(i)];
    View<const float> view;
    there(view, one.cols);
    out.targets.more.set(one.name, view);
  }
  out.tile_rays = tile_rays;
  return out;
}

BatchShape shape_of(const RayBatch& batch) {
  BatchShape shape;
  shape.rays = batch.origin.rows;
  shape.tiles = batch.label_only.empty() ? 0 : batch.label_only.rows;
  shape.tile_rays = batch.tile_rays;
  shape.labels = !batch.targets.label.empty();
  for (const auto& one : batch.targets.more) {
    SEMFIELD_CHECK(one.name.size() < BatchShape::kNameBytes, "the name of a channel has at most 31 characters");
    BatchShape::Channel& to = shape.more[static_cast<std::size_t>(shape.channels++)];
    std::memcpy(to.name, one.name.data(), one.name.size());
    to.cols = one.view.cols;
  }
  return shape;
}

double color_normaliser(const RayBatch& batch) {
  std::int64_t rays = batch.origin.rows;
  for (std::int64_t t = 0; t < batch.label_only.rows; ++t) rays -= batch.label_only(t, 0);
  return static_cast<double>(std::max<std::int64_t>(1, 3 * rays));
}

SemanticTargets semantic_targets(const RayTargets& targets, std::int64_t rays) {
  const View<const float> soft = targets.more[channel::soft_label];
  SemanticTargets out;
  if (soft.empty()) {
    out.hard = targets.label.row_range(0, rays);
  } else {
    out.soft = soft.row_range(0, rays);
  }
  return out;
}

}  // namespace semfield
