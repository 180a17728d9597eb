// Keys of transforms.json: those that are read, and what others look like.
#pragma once

#include <map>
#include <string>
#include <utility>

namespace semfield {

class TransformsKeys {
 public:
  /// `label_key` as in read_transforms.
  explicit TransformsKeys(std::string label_key) : label_key_(std::move(label_key)) {}

  /// The key that is read, of a file or with `of_frame` of one of its frames, that `key` is near; "" for one that is
  /// read itself, is known from other programs, or is near none.
  const std::string& meant_by(const std::string& key, bool of_frame);

 private:
  std::string label_key_;
  std::map<std::string, std::string> meant_[2];  // of a file, of a frame: keys met -> what they look like, or ""
};

}  // namespace semfield
