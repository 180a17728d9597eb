// Arrays of one message, one after the other: written row by row, or read where they lie.
#pragma once

#include <cstddef>
#include <cstring>
#include <type_traits>
#include <vector>

#include "core/view.h"

namespace semfield {

/// A message in `bytes`, which it begins anew. Whoever sends adds everything; whoever receives expects everything,
/// fills the bytes, and takes everything in the same order. Arrays with larger elements come before those with smaller
/// ones, so that each is aligned.
class ArrayMessage {
 public:
  explicit ArrayMessage(std::vector<std::byte>& bytes) : bytes_(bytes) { bytes_.clear(); }

  template <class T, class = std::enable_if_t<std::is_trivially_copyable_v<T>>>
  void add(const T& value) {
    append(&value, sizeof value);
  }
  template <class T>
  void add(const View<T>& view) {
    if (view.empty()) return;
    for (std::int64_t r = 0; r < view.rows; ++r) append(view.row(r), static_cast<std::size_t>(view.cols) * sizeof(T));
  }

  template <class T>
  void expect(const T&) {
    bytes_.resize(bytes_.size() + sizeof(T));
  }
  template <class T>
  void expect(const View<T>&, std::int64_t rows, std::int32_t cols) {
    bytes_.resize(bytes_.size() + size_of<T>(rows, cols));
  }

  template <class T>
  void take(T& value) {
    std::memcpy(&value, bytes_.data() + at_, sizeof value);
    at_ += sizeof value;
  }
  /// Into the message's bytes, which must outlive the view.
  template <class T>
  View<T> take(const View<T>&, std::int64_t rows, std::int32_t cols) {
    const View<T> view(reinterpret_cast<T*>(bytes_.data() + at_), rows, cols);
    at_ += size_of<T>(rows, cols);
    return view;
  }
  template <class T>
  void copy_into(const View<T>& to, std::int64_t rows, std::int32_t cols) {
    const View<T> from = take(to, rows, cols);
    for (std::int64_t r = 0; r < rows; ++r)
      std::memcpy(to.row(r), from.row(r), static_cast<std::size_t>(cols) * sizeof(T));
  }

 private:
  template <class T>
  static std::size_t size_of(std::int64_t rows, std::int32_t cols) {
    return static_cast<std::size_t>(rows) * static_cast<std::size_t>(cols) * sizeof(T);
  }
  void append(const void* data, std::size_t size) {
    const std::size_t begin = bytes_.size();
    bytes_.resize(begin + size);
    std::memcpy(bytes_.data() + begin, data, size);
  }

  std::vector<std::byte>& bytes_;
  std::size_t at_ = 0;
};

}  // namespace semfield
