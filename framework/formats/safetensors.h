// Named tensors in one file: the safetensors layout with checksums, and a strict reader.
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <memory>
#include <span>
#include <string>
#include <string_view>
#include <type_traits>
#include <utility>
#include <vector>

namespace semfield {

enum class TensorType : std::uint8_t { f32, f64, i64, u8 };

/// "F32", "F64", "I64", "U8", as the header spells them.
std::string_view tensor_type_name(TensorType type);
std::size_t tensor_type_bytes(TensorType type);

/// One tensor, borrowed: row-major, little-endian, contiguous.
struct TensorRef {
  std::string name;
  TensorType type = TensorType::f32;
  std::vector<std::int64_t> shape;
  std::span<const std::byte> bytes;
};

template <class T>
constexpr TensorType tensor_type_of() {
  return std::is_same_v<T, float>    ? TensorType::f32
         : std::is_same_v<T, double> ? TensorType::f64
         : sizeof(T) == 8            ? TensorType::i64
                                     : TensorType::u8;
}
/// Of float, double, std::int64_t or std::uint8_t, in a vector, a span or an array.
template <class Values>
TensorRef tensor_ref(std::string name, std::vector<std::int64_t> shape, const Values& values) {
  const std::span all(values);
  using T = std::remove_cv_t<typename decltype(all)::element_type>;
  static_assert(std::is_floating_point_v<T> || std::is_same_v<T, std::int64_t> || std::is_same_v<T, std::uint8_t>);
  return {std::move(name), tensor_type_of<T>(), std::move(shape), std::as_bytes(all)};
}

using TensorMetadata = std::map<std::string, std::string>;

/// File image: 8-byte little-endian header length, JSON header (dtype, shape, data_offsets, `__metadata__`), data
/// without holes. Metadata keys starting with "semfield.crc32c" are ours: one CRC-32C a tensor and one over the whole
/// file (its own eight digits taken as zeros). Throws Error(internal) for duplicate names or sizes that do not fit the
/// shape.
std::string encode_safetensors(const std::vector<TensorRef>& tensors, const TensorMetadata& metadata);

/// encode_safetensors, then written atomically; read back and verified before it takes the name. Throws Error(io or
/// cannot_create).
void write_safetensors(const std::string& path, const std::vector<TensorRef>& tensors, const TensorMetadata& metadata);

/// A verified file in memory; the tensors borrow from it.
class TensorFile {
 public:
  struct Limits {
    std::size_t file_bytes = std::size_t{64} << 30;
    std::size_t header_bytes = 100'000'000;
    bool refuse_nonfinite = true;  ///< NaN or infinity in F32/F64 tensors
    bool require_checksums = true;
  };

  TensorFile() = default;
  TensorFile(TensorFile&&) = default;
  TensorFile& operator=(TensorFile&&) = default;
  TensorFile(const TensorFile&) = delete;
  TensorFile& operator=(const TensorFile&) = delete;

  /// Throws Error(no_input) when it cannot be opened and Error(data), naming file, tensor and remedy, for anything
  /// else.
  static TensorFile read(const std::string& path, const Limits& limits);
  static TensorFile read(const std::string& path) { return read(path, Limits{}); }
  /// The same for bytes in memory; `name` stands for the file in messages.
  static TensorFile decode(std::string bytes, const std::string& name, const Limits& limits);

  const TensorMetadata& metadata() const { return metadata_; }  ///< without the checksums
  const std::vector<TensorRef>& tensors() const { return tensors_; }
  const TensorRef* find(std::string_view name) const;
  /// Values of a tensor of this element count, copied out. Throws Error(data) when absent, of another type or size.
  std::vector<float> floats(std::string_view name, std::int64_t count) const;
  std::vector<std::int64_t> integers(std::string_view name, std::int64_t count) const;
  const std::string& name() const { return name_; }

 private:
  friend class TensorFileReader;
  const TensorRef& require(std::string_view name, TensorType type, std::int64_t count) const;
  template <class T>
  std::vector<T> values_of(std::string_view name, std::int64_t count) const;
  std::unique_ptr<std::string> bytes_;  // held by pointer: tensors point into it, and the file may be moved
  std::string name_;
  TensorMetadata metadata_;
  std::vector<TensorRef> tensors_;  // in the order of their data
};

}  // namespace semfield
