// NumPy arrays: .npy files and .npz archives, as numpy.save, savez and savez_compressed write them.
#pragma once

#include <cstdint>
#include <functional>
#include <span>
#include <string>
#include <vector>

namespace semfield {

/// Values in C order, whatever the order in the file. uint8 is divided by 255, so that 255 reads as 1.
struct NumpyArray {
  std::vector<std::int64_t> shape;
  std::vector<float> values;
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
/// The shape that the header tells; the same errors, and no value is read.
std::vector<std::int64_t> npy_shape(const std::string& path);

/// One array of an archive; `key` is its name without ".npy". Entries may be stored or deflated, with ZIP64 sizes.
/// Throws Error naming file and entry: no archive, a directory or an entry that runs past the end, another compression,
/// a wrong checksum, no such key (with the keys that there are), and as read_npy.
NumpyArray read_npz(const std::string& path, const std::string& key, const AcceptShape& accept);
/// Keys in the order of the archive.
std::vector<std::string> npz_keys(const std::string& path);

/// The beginning of a .npy file, behind which the values follow in C order. `type` as NumPy writes it: "<f4", "|i1".
std::string npy_header(const std::string& type, std::span<const std::int64_t> shape);

/// An array to write; the values are rounded to float16.
struct NpzEntry {
  std::string key;
  std::vector<std::int64_t> shape;
  std::span<const float> values;
};
/// Deflated entries, no times: equal arrays give equal files. Throws Error(io) for what cannot be written and
/// Error(data) for an archive over 2 GiB.
void write_npz(const std::string& path, std::span<const NpzEntry> entries);

}  // namespace semfield
