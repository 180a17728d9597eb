// Little-endian values and text in large pieces into a file that appears whole or not at all.
#pragma once

#include <bit>
#include <cstring>
#include <string_view>
#include <type_traits>
#include <vector>

#include "system/files.h"

namespace semfield {

class BufferedFile {
 public:
  explicit BufferedFile(const std::string& path) : file_(path) {}

  void text(std::string_view words) { bytes(words.data(), words.size()); }
  template <class T>
  void value(T number) {
    static_assert(std::is_arithmetic_v<T> && std::endian::native == std::endian::little);
    bytes(&number, sizeof number);
  }
  void commit() {
    flush();
    file_.commit();
  }

 private:
  void bytes(const void* data, std::size_t count) {
    const std::size_t at = pending_.size();
    pending_.resize(at + count);
    std::memcpy(pending_.data() + at, data, count);
    if (pending_.size() >= kPiece) flush();
  }
  void flush() {
    file_.append(pending_);
    pending_.clear();
  }

  static constexpr std::size_t kPiece = std::size_t{1} << 20;
  AtomicFile file_;
  std::vector<std::byte> pending_;
};

}  // namespace semfield
