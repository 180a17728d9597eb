// Values of label images that stand for no class: one finding for all frames of a scene.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/error.h"
#include "scene/scene.h"

namespace semfield {

/// Values as text, numbers in their order.
struct ByLengthThenText {
  bool operator()(const std::string& a, const std::string& b) const {
    return std::pair(a.size(), std::string_view(a)) < std::pair(b.size(), std::string_view(b));
  }
};
/// Value -> the first of its pixels.
using UnknownValues = std::map<std::string, std::size_t, ByLengthThenText>;

/// What reading one label image throws for the values that its classes lack. `noun` is "label id" or "colour".
class UnknownLabelError final : public Error {
 public:
  UnknownLabelError(std::string noun, UnknownValues values, const std::string& path, std::int32_t width_px,
                    std::string remedy);

 private:
  friend void report_unknown_labels(const std::vector<FrameInfo>&, const std::vector<std::optional<UnknownLabelError>>&,
                                    Diagnostics&);
  std::string noun_, first_;
  UnknownValues values_;
};

/// One error for those of `frames` that have one, under the place of the first.
void report_unknown_labels(const std::vector<FrameInfo>& frames,
                           const std::vector<std::optional<UnknownLabelError>>& found, Diagnostics& diagnostics);

}  // namespace semfield
