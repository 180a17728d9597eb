// Named channels: what rays carry in addition to what every ray has, as a small table of views by name.
#pragma once

#include <array>
#include <cstddef>
#include <string_view>

#include "core/check.h"
#include "core/view.h"

namespace semfield {

/// Names of the channels that the framework itself fills. Targets, a row per ray of a batch:
///   color       [R, 3] in [0, 1]
///   label       [R, 1] class, negative: none
///   soft_label  [R, C] class probabilities; a row of zeros: none
///   depth       [R, 1] metres along the ray; 0: unknown
///   alpha       [R, 1] how much of the pixel the subject covers, 0 to 1; negative: unknown
///   camera      [R, 1] number of the training camera
/// Outputs of a pass, a row per ray:
///   color       [R, 3]
///   depth       [R, 1] sum of w t, metres along the ray
///   opacity     [R, 1] sum of w
///   logits      [S, C] of the first S rays, those behind them have no label
/// and a row per sample: weight [M, 1], sigma [M, 1] 1/m after activation.
namespace channel {
inline constexpr std::string_view color = "color", label = "label", soft_label = "soft_label", depth = "depth",
                                  alpha = "alpha", camera = "camera", opacity = "opacity", weight = "weight",
                                  sigma = "sigma", logits = "logits";
}  // namespace channel

/// Most channels that a table holds.
inline constexpr std::size_t kMostChannels = 8;

/// Views by name, all of the same rows. It owns neither: names and numbers outlive the table. Copies allocate nothing.
template <class T>
class ChannelTable {
 public:
  struct Channel {
    std::string_view name;
    View<T> view;
  };

  ChannelTable() = default;
  template <class Other>
  ChannelTable(const ChannelTable<Other>& other) {  // NOLINT: of const views
    for (const auto& one : other) set(one.name, one.view);
  }

  /// An empty view where no channel has the name.
  View<T> operator[](std::string_view name) const {
    for (const Channel& one : *this)
      if (one.name == name) return one.view;
    return {};
  }
  /// Adds a channel, or replaces that of this name.
  void set(std::string_view name, View<T> view) {
    for (std::size_t i = 0; i < count_; ++i) {
      if (all_[i].name != name) continue;
      all_[i].view = view;
      return;
    }
    SEMFIELD_CHECK(count_ < kMostChannels, "too many channels");
    all_[count_++] = {name, view};
  }
  /// Rows [begin, begin + count) of every channel that has any.
  ChannelTable row_range(std::int64_t begin, std::int64_t count) const {
    ChannelTable out;
    for (const Channel& one : *this) out.set(one.name, one.view.empty() ? one.view : one.view.row_range(begin, count));
    return out;
  }

  std::size_t size() const { return count_; }
  const Channel* begin() const { return all_.data(); }
  const Channel* end() const { return all_.data() + count_; }
  Channel* begin() { return all_.data(); }
  Channel* end() { return all_.data() + count_; }

 private:
  std::array<Channel, kMostChannels> all_{};
  std::size_t count_ = 0;
};

}  // namespace semfield
