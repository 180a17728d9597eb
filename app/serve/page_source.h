// The handful of calls that the page's server makes: a labelling session, or a fake in tests.
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>

#include "formats/image_io.h"
#include "serve/label_loop.h"

namespace semfield::app {

/// Called from several threads at once; see LabelSession for what each call does and throws. `view` is always the
/// number of a view that is there.
class PageSource {
 public:
  virtual ~PageSource() = default;
  virtual bool apply(const LabelEvent& event) = 0;
  virtual std::shared_ptr<const LabelState> state() const = 0;
  virtual std::shared_ptr<const LabelState> wait_state(std::uint64_t after, std::chrono::milliseconds most) const = 0;
  virtual Picture picture(const PictureRequest& request, const std::function<bool()>& abandoned) = 0;
  /// Photograph of a view as its file has it. Where its longest side would be brought down to `most_px` (0: never)
  /// anyhow, a smaller one may be given that still is as large.
  virtual Image<std::uint8_t> photo(int view, std::int32_t most_px) = 0;
  virtual FreeCamera camera_of(int view) const = 0;
  /// Number of the view that shows a frame of the scene; -1: none.
  virtual int view_of(int frame) const = 0;
  /// Writes a checkpoint, and returns when it is there.
  virtual void save() = 0;
};

}  // namespace semfield::app
