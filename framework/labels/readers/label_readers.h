// The kinds of label files that `scene.labels.from` may name; each is made in a file of its own.
#pragma once

#include <memory>
#include <string>

#include "core/error.h"
#include "labels/label_steps.h"

namespace semfield {

std::unique_ptr<LabelReader> make_labelme_reader();
std::unique_ptr<LabelReader> make_coco_reader();
std::unique_ptr<LabelReader> make_image_label_reader();
std::unique_ptr<LabelReader> make_npz_reader();
std::unique_ptr<LabelReader> make_click_reader();

/// Throws Error(data): "<place>: <message>".
[[noreturn]] inline void refuse_labels(const std::string& place, const std::string& message,
                                       const std::string& remedy = {}) {
  throw Error(ErrorKind::data, place + ": " + message, remedy);
}

}  // namespace semfield
