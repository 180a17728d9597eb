// The handful of calls that the page's server makes: a labelling session, or a fake in tests.
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <span>

#include "serve/label_state.h"

namespace semfield::app {

struct PagePhoto {
  std::int32_t width_px = 0, height_px = 0;
  std::span<const std::uint8_t> rgb;  ///< [height * width * 3], as long as the source is there
};

/// Called from several threads at once; see LabelSession for what each call does and throws. `view` is always the
/// number of a view that is there.
class PageSource {
 public:
  virtual ~PageSource() = default;
  virtual bool apply(const LabelEvent& event) = 0;
  virtual std::shared_ptr<const LabelState> state() const = 0;
  virtual std::shared_ptr<const LabelState> wait_state(std::uint64_t after, std::chrono::milliseconds most) const = 0;
  virtual Picture picture(const PictureRequest& request, const std::function<bool()>& abandoned) = 0;
  virtual PagePhoto photo(int view) const = 0;
  virtual FreeCamera camera_of(int view) const = 0;
  /// Number of the view that shows a frame of the scene; -1: none.
  virtual int view_of(int frame) const = 0;
  /// Writes a checkpoint, and returns when it is there.
  virtual void save() = 0;
};

}  // namespace semfield::app
