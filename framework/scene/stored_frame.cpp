// Packing of loaded frames; every packing is undone exactly.
#include "scene/stored_frame.h"

#include <algorithm>
#include <cmath>

#include "scene/alpha.h"

namespace semfield {

LabelMap::LabelMap(std::vector<std::int16_t> labels) {
  const bool fits = std::all_of(labels.begin(), labels.end(),
                                [](std::int16_t c) { return c == kVoid || (c >= 0 && c < kNarrowVoid); });
  if (!fits) {
    wide_ = std::move(labels);
    return;
  }
  narrow_.resize(labels.size());
  std::transform(labels.begin(), labels.end(), narrow_.begin(),
                 [](std::int16_t c) { return c == kVoid ? kNarrowVoid : static_cast<std::uint8_t>(c); });
}

std::vector<std::int16_t> LabelMap::expand() const {
  if (narrow_.empty()) return wide_;
  std::vector<std::int16_t> out(narrow_.size());
  for (std::size_t i = 0; i < out.size(); ++i) out[i] = (*this)[i];
  return out;
}

DepthMap::DepthMap(std::vector<float> depth_m) {
  millimetres_.resize(depth_m.size());
  constexpr std::size_t kBlock = 4096;  // most maps in other units are told after the first of them
  for (std::size_t begin = 0; begin < depth_m.size(); begin += kBlock) {
    const std::size_t end = std::min(begin + kBlock, depth_m.size());
    int misses = 0;
    for (std::size_t i = begin; i < end; ++i) {
      const double mm = std::rint(static_cast<double>(depth_m[i]) * 1000.0);
      const double held = mm >= 0 && mm <= 65535 ? mm : 0;  // NaN and what does not fit differ below
      const auto whole = static_cast<std::uint16_t>(static_cast<std::int32_t>(held));
      millimetres_[i] = whole;
      misses += metres_of(whole) == depth_m[i] ? 0 : 1;
    }
    if (misses > 0) {
      millimetres_ = {};
      metres_ = std::move(depth_m);
      return;
    }
  }
}

std::vector<float> DepthMap::expand() const {
  if (millimetres_.empty()) return metres_;
  std::vector<float> out(millimetres_.size());
  for (std::size_t i = 0; i < out.size(); ++i) out[i] = metres_of(millimetres_[i]);
  return out;
}

StoredFrame::StoredFrame(FrameBuffer frame)
    : width_px(frame.width_px),
      height_px(frame.height_px),
      rgb(std::move(frame.rgb)),
      depth_m(std::move(frame.depth_m)),
      label(std::move(frame.label)),
      instance(std::move(frame.instance)),
      mask(frame.used),
      channels(std::move(frame.channels)) {
  const auto of_alpha =
      std::find_if(channels.begin(), channels.end(), [](const FrameChannel& c) { return c.name == kAlphaChannel; });
  if (of_alpha == channels.end()) return;
  alpha = alpha_bytes(*of_alpha);
  channels.erase(of_alpha);
}

const FrameChannel* StoredFrame::channel(std::string_view name) const {
  const auto found =
      std::find_if(channels.begin(), channels.end(), [&](const FrameChannel& c) { return c.name == name; });
  return found == channels.end() ? nullptr : &*found;
}

void StoredFrame::read_channel(std::string_view name, std::int32_t index, std::span<float> out) const {
  const FrameChannel* const from = channel(name);
  if (from == nullptr) return std::fill(out.begin(), out.end(), 0.0F);
  const std::int64_t row = std::int64_t{index / width_px} * from->height / height_px;
  const std::int64_t col = std::int64_t{index % width_px} * from->width / width_px;
  const float* const cell = from->values.data() + (row * from->width + col) * from->cols;
  std::copy(cell, cell + from->cols, out.begin());
}

std::size_t StoredFrame::bytes() const {
  std::size_t sum =
      rgb.capacity() + alpha.capacity() + depth_m.bytes() + label.bytes() + mask.bytes() + instance.capacity() * 4;
  for (const FrameChannel& one : channels) sum += one.values.capacity() * sizeof(float);
  return sum;
}

}  // namespace semfield
