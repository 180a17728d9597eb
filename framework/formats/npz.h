// NumPy arrays: .npy files and .npz archives, as numpy.save, savez and savez_compressed write them.
#pragma once

#include <cstdint>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "formats/zip_archive.h"

namespace semfield {

/// Values in C order, whatever the order in the file.
template <class T>
struct NumpyNumbers {
  std::vector<std::int64_t> shape;
  std::vector<T> values;
};

/// uint8 is divided by 255, so that 255 reads as 1.
struct NumpyArray : NumpyNumbers<float> {
  bool from_bytes = false;  ///< the file holds uint8
};

/// "(240, 320, 4)"
std::string shape_text(std::span<const std::int64_t> shape);

/// Throws for a shape that the caller cannot use. It is asked before anything but the header is read or unpacked.
using AcceptShape = std::function<void(std::span<const std::int64_t> shape)>;

/// float16, float32, float64 or uint8 of either byte order, up to 8 axes. Throws Error naming the file and the cause:
/// no .npy, a header that cannot be read, another type, a shape that the bytes of the file do not fill exactly, what
/// `accept` throws, and arrays over limits.image_bytes. Nothing is allocated on the word of a header.
NumpyArray read_npy(const std::string& path, const AcceptShape& accept);
/// The shape that the header tells, of real numbers or integers; the same errors, and no value is read.
std::vector<std::int64_t> npy_shape(const std::string& path);

/// Numbers as they are stored.
struct NumpyValues : NumpyNumbers<double> {
  bool is_whole = false;          ///< the file holds integers
  std::size_t element_bytes = 0;  ///< of one number in the file
};
/// As read_npy, of real numbers and of integers but uint64.
NumpyValues read_npy_values(const std::string& path, const AcceptShape& accept);
/// Whether it holds integers; nothing but the header is read.
bool npy_is_whole(const std::string& path);

/// An archive in memory. Entries may be stored or deflated, with ZIP64 sizes; a key is the name of an array without
/// ".npy". All throw Error naming file and entry: no archive, a directory or an entry that runs past the end, another
/// compression, a wrong checksum, no such key (with the keys that there are), and as read_npy.
class NpzFile {
 public:
  explicit NpzFile(std::string path);
  const std::vector<std::string>& keys() const { return keys_; }  ///< in the order of the archive
  NumpyArray read(const std::string& key, const AcceptShape& accept) const;
  /// Of bool or uint8, as they are stored; no other type.
  NumpyNumbers<std::uint8_t> bytes(const std::string& key, const AcceptShape& accept) const;
  /// Of integers but uint64; no other type.
  NumpyNumbers<std::int64_t> whole(const std::string& key, const AcceptShape& accept) const;

 private:
  const ZipEntry& entry(const std::string& key) const;

  std::string path_, file_;
  std::vector<ZipEntry> entries_;
  std::vector<std::string> keys_;
};

/// The beginning of a .npy file, behind which the values follow in C order. `type` as NumPy writes it: "<f4", "|i1".
std::string npy_header(const std::string& type, std::span<const std::int64_t> shape);
/// The same with the shape as shape_text() writes it.
std::string npy_header(const std::string& type, const std::string& axes);

}  // namespace semfield
