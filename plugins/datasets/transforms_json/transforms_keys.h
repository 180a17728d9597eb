// Keys of transforms.json: those that are read, and what others look like.
#pragma once

#include <map>
#include <set>
#include <string>
#include <utility>
#include <vector>

namespace semfield {

class TransformsKeys {
 public:
  /// As in read_transforms.
  TransformsKeys(const std::string& label_key, const std::vector<std::string>& channels) : named_{label_key} {
    for (const std::string& name : channels) named_.push_back(name + "_path");
  }

  /// The key that is read, of a file or with `of_frame` of one of its frames, that `key` is near; "" for one that is
  /// read itself, is known from other programs, or is near none.
  const std::string& meant_by(const std::string& key, bool of_frame);

  /// A key NAME_path of a frame that names a .npy and that nothing reads is remembered by its name.
  void look_for_map(const std::string& key, const std::string& file);
  const std::set<std::string>& unread_maps() const { return unread_maps_; }

 private:
  std::vector<std::string> named_;  // keys of frames that the configuration names
  std::set<std::string> unread_maps_;
  std::map<std::string, std::string> meant_[2];  // of a file, of a frame: keys met -> what they look like, or ""
};

}  // namespace semfield
