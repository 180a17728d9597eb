#include "scene/scene.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "core/text.h"
#include "scene/scene_checks.h"

namespace semfield {

Split HoldOut::split_of(std::size_t rank, std::size_t frames) const {
  if (every <= 0 || frames < 2) return Split::train;
  return rank % static_cast<std::size_t>(every) == static_cast<std::size_t>(first) ? Split::test : Split::train;
}

void check_test_every(std::int32_t every, Diagnostics& diagnostics) {
  if (every == 1)
    diagnostics.error("scene.split.empty", "test_every", "1 leaves no frame to train on",
                      "take 2 or more, or 0 for no test frames");
}

namespace {

constexpr std::size_t kMostBytes = 200;  // file systems take 255, and kinds and endings follow

}  // namespace

std::string output_name(std::string_view frame) {
  std::string name(frame);
  std::replace(name.begin(), name.end(), '/', '_');
  return name;
}

std::optional<std::string> OutputNames::add(const std::string& frame) {
  if (frame.empty()) return "its name is empty";
  if (frame.size() > kMostBytes)
    return "its name has " + std::to_string(frame.size()) + " bytes; at most " + std::to_string(kMostBytes) +
           " are allowed";
  if (!is_line_of_text(frame)) return "its name has a control character, or is not UTF-8";
  const auto [other, fresh] = frames_.emplace(output_name(frame), frame);
  if (fresh) return std::nullopt;
  if (other->second == frame) return "another one has its name";
  return "its files would be called '" + other->first + "', as those of '" + other->second + "'";
}

void check_output_names(const SceneInfo& info, Diagnostics& diagnostics) {
  OutputNames names;
  for (const FrameInfo& frame : info.frames) {
    if (const auto wrong = names.add(frame.name))
      diagnostics.error("scene.frame.name", frame_place(frame), *wrong, kFrameNameRemedy);
  }
}

// Packing of loaded frames; every packing is undone exactly.

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

// Masks as bits.

PixelMask::PixelMask(std::span<const std::uint8_t> used) {
  masked_px_ = std::count(used.begin(), used.end(), std::uint8_t{0});
  if (masked_px_ == 0) return;
  pixels_ = used.size();
  words_.resize((pixels_ + 63) / 64);
  for (std::size_t i = 0; i < pixels_; ++i) words_[i / 64] |= std::uint64_t{used[i] != 0 ? 1U : 0U} << (i % 64);
}

std::vector<std::uint8_t> PixelMask::expand() const {
  std::vector<std::uint8_t> out(pixels_);
  for (std::size_t i = 0; i < pixels_; ++i) out[i] = uses(i) ? 1 : 0;
  return out;
}

void hide_masked(FrameBuffer& frame) {
  for (std::size_t i = 0; i < frame.used.size(); ++i) {
    if (frame.used[i] != 0) continue;
    std::fill_n(frame.rgb.begin() + static_cast<std::ptrdiff_t>(3 * i), 3, std::uint8_t{0});
    if (!frame.depth_m.empty()) frame.depth_m[i] = 0;
    if (!frame.label.empty()) frame.label[i] = kVoid;
    if (!frame.instance.empty()) frame.instance[i] = 0;
  }
}

FrameChannelInfo alpha_info(const Camera& camera) {
  return {std::string(kAlphaChannel), camera.height_px, camera.width_px, 1};
}

FrameChannel alpha_channel(std::int32_t width_px, std::int32_t height_px, std::span<const std::uint8_t> alpha) {
  FrameChannel out{std::string(kAlphaChannel), height_px, width_px, 1, {}};
  out.values.reserve(alpha.size());
  for (const std::uint8_t a : alpha) out.values.push_back(static_cast<float>(a) / 255.0F);
  return out;
}

std::vector<std::uint8_t> alpha_bytes(const FrameChannel& channel) {
  std::vector<std::uint8_t> out;
  out.reserve(channel.values.size());
  for (const float a : channel.values) out.push_back(static_cast<std::uint8_t>(std::lround(a * 255.0F)));
  return out;
}

namespace {

constexpr std::size_t kListed = 16;

using FrameCounts = std::map<std::string, int, ByLengthThenText>;

std::string sentence(const std::string& noun, const FrameCounts& frames, const std::string& first) {
  std::vector<std::string> listed;
  for (const auto& [value, count] : frames) {
    if (listed.size() == kListed) {
      listed.push_back(std::to_string(frames.size() - kListed) + " more");
      break;
    }
    listed.push_back(value + (count > 1 ? " (" + std::to_string(count) + " frames)" : ""));
  }
  return noun + (frames.size() > 1 ? "s " + join(listed) + " are" : " " + listed.front() + " is") +
         " not in the class table, first at " + first;
}

FrameCounts counts_of(const UnknownValues& values) {
  FrameCounts counts;
  for (const auto& [value, pixel] : values) counts[value] = 1;
  return counts;
}

std::string first_of(const UnknownValues& values, const std::string& path, std::int32_t width_px) {
  std::size_t pixel = values.begin()->second;
  for (const auto& [value, at] : values) pixel = std::min(pixel, at);
  const auto width = static_cast<std::size_t>(width_px);
  return "x " + std::to_string(pixel % width) + ", y " + std::to_string(pixel / width) + " of '" + path + "'";
}

}  // namespace

UnknownLabelError::UnknownLabelError(std::string noun, UnknownValues values, const std::string& path,
                                     std::int32_t width_px, std::string remedy)
    : Error(ErrorKind::data, "labels.id.unknown", sentence(noun, counts_of(values), first_of(values, path, width_px)),
            std::move(remedy)),
      noun_(std::move(noun)),
      first_(first_of(values, path, width_px)),
      values_(std::move(values)) {}

void report_unknown_labels(const std::vector<FrameInfo>& frames,
                           const std::vector<std::optional<UnknownLabelError>>& found, Diagnostics& diagnostics) {
  FrameCounts counts;
  std::optional<std::size_t> first;
  for (std::size_t i = 0; i < found.size(); ++i) {
    if (!found[i]) continue;
    if (!first) first = i;
    for (const auto& [value, pixel] : found[i]->values_) ++counts[value];
  }
  if (!first) return;
  const UnknownLabelError& e = *found[*first];
  diagnostics.error(e.code(), frame_place(frames[*first]), sentence(e.noun_, counts, e.first_), e.remedy());
}

}  // namespace semfield
