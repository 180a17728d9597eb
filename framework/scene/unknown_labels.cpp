#include "scene/unknown_labels.h"

#include <algorithm>
#include <vector>

#include "scene/scene_checks.h"

namespace semfield {

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
