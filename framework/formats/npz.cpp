#include "formats/npz.h"

#include <algorithm>
#include <bit>

#include "core/error.h"
#include "core/files.h"
#include "core/half.h"
#include "core/text.h"
#include "formats/text_rows.h"

namespace semfield {

namespace {

constexpr std::size_t kMaxArrayFileBytes = std::size_t{2} << 30;
constexpr std::size_t kMaxAxes = 8;
constexpr std::size_t kHeadBytes = std::size_t{1} << 17;  // more than a header of version 1 can be

[[noreturn]] void refuse_array(Code code, const std::string& message, const std::string& remedy = {}) {
  throw Error(ErrorKind::data, code, message, remedy);
}

struct ArrayHeader {
  std::string type;
  bool fortran = false;
  std::vector<std::int64_t> shape;
  std::size_t data_at = 0;

  char kind() const { return type[1]; }
  std::size_t element_bytes() const { return static_cast<std::size_t>(type[2] - '0'); }
};

// `size` bytes as one number.
std::uint64_t bits_at(const char* at, std::size_t size, bool big_endian = false) {
  std::uint64_t bits = 0;
  for (std::size_t i = 0; i < size; ++i)
    bits |= std::uint64_t{static_cast<unsigned char>(at[big_endian ? size - 1 - i : i])} << (8 * i);
  return bits;
}

// Types that a reader of numbers T takes, without the byte order, and what to do about others.
template <class T>
constexpr std::string_view kKinds = "f2 f4 f8 i1 i2 i4 i8 u1 u2 u4";
template <>
constexpr std::string_view kKinds<float> = "f2 f4 f8 u1";
template <>
constexpr std::string_view kKinds<std::uint8_t> = "b1 u1";
template <>
constexpr std::string_view kKinds<std::int64_t> = "i1 i2 i4 i8 u1 u2 u4";
template <class T>
constexpr const char* kSaveAs = "save it as float32, float64 or integers";
template <>
constexpr const char* kSaveAs<float> = "save it as float16, float32, float64 or uint8";
template <>
constexpr const char* kSaveAs<std::uint8_t> = "save it as bool or uint8";
template <>
constexpr const char* kSaveAs<std::int64_t> = "save it as int64";

// A value of the file as a T: 255 bytes of a reader of float are 1.
template <class T>
T value_at(const ArrayHeader& header, const char* at, std::size_t size, bool big_endian) {
  const std::uint64_t bits = bits_at(at, size, big_endian);
  if (header.kind() == 'f') {
    if (size == 2) return static_cast<T>(float_of_half(static_cast<std::uint16_t>(bits)));
    if (size == 4) return static_cast<T>(std::bit_cast<float>(static_cast<std::uint32_t>(bits)));
    return static_cast<T>(std::bit_cast<double>(bits));
  }
  const auto above = static_cast<int>(64 - 8 * size);
  const auto whole =
      header.kind() == 'i' ? static_cast<std::int64_t>(bits << above) >> above : static_cast<std::int64_t>(bits);
  return std::is_same_v<T, float> ? static_cast<T>(whole) / T(255) : static_cast<T>(whole);
}

// Text behind 'KEY': in the header, a Python dictionary; up to `end`, which is left out.
std::string_view value_of(std::string_view header, std::string_view key, std::string_view end) {
  for (const char quote : {'\'', '"'}) {
    const std::string wanted = quote + std::string(key) + quote;
    const std::size_t at = header.find(wanted);
    if (at == std::string_view::npos) continue;
    const std::size_t first = header.find_first_not_of(" :", at + wanted.size());
    const std::size_t last = header.find_first_of(end, first);
    if (first != std::string_view::npos && last != std::string_view::npos) return header.substr(first, last - first);
  }
  refuse_array("files.array.format", "the header has no '" + std::string(key) + "'", kSaveAgain);
}

ArrayHeader header_of(std::string_view bytes) {
  if (bytes.size() < 10 || bytes.substr(0, 6) != "\x93NUMPY")
    refuse_array("files.array.format", "not a NumPy array: it begins with other bytes");
  const int version = bytes[6];
  if (version < 1 || version > 3)
    refuse_array("files.array.format", "NumPy format version " + std::to_string(version) + " is not read");
  const std::size_t start = version == 1 ? 10 : 12;
  if (bytes.size() < start) refuse_array("files.array.format", "the header runs past the end of the file", kSaveAgain);
  const std::size_t length = static_cast<std::size_t>(bits_at(bytes.data() + 8, start - 8));
  if (length > kHeadBytes - start)
    refuse_array("files.array.format", "a header of " + std::to_string(length) + " bytes is not read", kSaveAgain);
  if (length > bytes.size() - start)
    refuse_array("files.array.format", "the header runs past the end of the file", kSaveAgain);
  const std::string_view text = bytes.substr(start, length);

  ArrayHeader header;
  header.data_at = start + length;
  const std::string_view type = value_of(text, "descr", ",}");
  if (type.size() < 3) refuse_array("files.array.format", "the header's 'descr' cannot be read", kSaveAgain);
  header.type = type.substr(1, type.size() - 2);
  const std::string_view order = value_of(text, "fortran_order", ",}");
  if (order != "True" && order != "False")
    refuse_array("files.array.format", "the header's 'fortran_order' is neither True nor False", kSaveAgain);
  header.fortran = order == "True";
  std::string_view axes = value_of(text, "shape", ")");
  if (axes.empty() || axes[0] != '(')
    refuse_array("files.array.format", "the header's 'shape' is not a tuple", kSaveAgain);
  axes.remove_prefix(1);
  while (!axes.empty()) {
    const std::size_t end = std::min(axes.find(','), axes.size());
    std::string_view number = axes.substr(0, end);
    axes.remove_prefix(std::min(end + 1, axes.size()));
    while (!number.empty() && number.front() == ' ') number.remove_prefix(1);
    if (number.empty() && axes.empty()) break;  // "(3,)"
    std::int64_t axis = 0;
    if (!parse_whole(number, axis) || axis < 0)
      refuse_array("files.array.format", "the header's shape has the axis '" + std::string(number) + "'");
    header.shape.push_back(axis);
  }
  if (header.shape.size() > kMaxAxes)
    refuse_array("files.array.format",
                 std::to_string(header.shape.size()) + " axes; at most " + std::to_string(kMaxAxes) + " are read");
  return header;
}

// Elements of the array; every factor is checked against what the file can hold.
std::uint64_t element_count(const ArrayHeader& header, std::uint64_t bytes, std::uint64_t element_bytes) {
  const std::uint64_t most = bytes / element_bytes;
  std::uint64_t count = 1;
  bool fits = true;
  if (std::find(header.shape.begin(), header.shape.end(), 0) != header.shape.end()) {
    count = 0;
  } else {
    for (const std::int64_t axis : header.shape) {
      fits = fits && static_cast<std::uint64_t>(axis) <= most / count;
      if (fits) count *= static_cast<std::uint64_t>(axis);
    }
  }
  if (!fits || count * element_bytes != bytes) {
    refuse_array("files.array.format",
                 "the header states the shape " + shape_text(header.shape) + " of type " + header.type + ", " +
                     std::to_string(bytes) + " bytes follow it",
                 kSaveAgain);
  }
  return count;
}

// take(place in Fortran order, place in C order) of every element.
template <class Take>
void for_each_of_fortran(const std::vector<std::int64_t>& shape, std::uint64_t count, const Take& take) {
  std::vector<std::size_t> size(shape.begin(), shape.end()), at(shape.size()), step(shape.size(), 1);
  for (std::size_t a = shape.size(); a-- > 1;) step[a - 1] = step[a] * size[a];
  for (std::size_t from = 0, to = 0; from < count; ++from) {
    take(from, to);
    for (std::size_t a = 0; a < size.size(); ++a) {  // the first axis is the fastest
      to += step[a];
      if (++at[a] < size[a]) break;
      to -= size[a] * step[a];
      at[a] = 0;
    }
  }
}

// The header of an array of `bytes` bytes in all, which begins as `start` does: checked, and taken by `accept`.
template <class T>
ArrayHeader checked_header(std::string_view start, std::uint64_t bytes, const AcceptShape& accept) {
  const ArrayHeader header = header_of(start);
  const std::vector<std::string_view> kinds = words_of(kKinds<T>);
  if (std::find(kinds.begin(), kinds.end(), std::string_view(header.type).substr(1)) == kinds.end() ||
      std::string_view("<>=|").find(header.type[0]) == std::string_view::npos) {
    refuse_array("files.array.type", "arrays of type '" + header.type + "' are not read", kSaveAs<T>);
  }
  const std::uint64_t count = element_count(header, bytes - header.data_at, header.element_bytes());
  if (accept) accept(header.shape);
  check_input_limit(static_cast<std::int64_t>(count * std::max(header.element_bytes(), sizeof(T))),
                    input_limits().image_bytes, "array of the shape " + shape_text(header.shape) + ": ",
                    "bytes once decoded", "image_bytes");
  return header;
}

template <class T>
NumpyNumbers<T> numbers_of(const ArrayHeader& header, std::string_view bytes) {
  const std::string_view data = bytes.substr(header.data_at);
  const std::size_t size = header.element_bytes();
  const std::uint64_t count = element_count(header, data.size(), size);  // a file may shrink after its header is read
  NumpyNumbers<T> out{header.shape, std::vector<T>(count)};
  const bool big_endian = header.type[0] == '>';
  const auto put = [&](std::size_t from, std::size_t to) {
    out.values[to] = value_at<T>(header, data.data() + from * size, size, big_endian);
  };
  if (header.fortran && count > 0 && header.shape.size() > 1) {
    for_each_of_fortran(header.shape, count, put);
  } else {
    for (std::size_t i = 0; i < count; ++i) put(i, i);
  }
  return out;
}

NumpyArray array_of(const ArrayHeader& header, std::string_view bytes) {
  return {numbers_of<float>(header, bytes), header.kind() == 'u'};
}

std::string key_of(const std::string& name) {
  return name.size() > 4 && name.substr(name.size() - 4) == ".npy" ? name.substr(0, name.size() - 4) : name;
}

}  // namespace

std::string shape_text(std::span<const std::int64_t> shape) {
  std::string out = "(";
  for (std::size_t a = 0; a < shape.size(); ++a) {
    if (a > 0) out += ", ";
    out += std::to_string(shape[a]);
  }
  out += shape.size() == 1 ? ",)" : ")";
  return out;
}

namespace {
// `use` gets the checked header; errors name the file.
template <class T, class Use>
auto with_header(const std::string& path, const AcceptShape& accept, const Use& use) {
  return naming(path, [&] {
    const std::string start = read_file_start(path, kHeadBytes);
    return use(checked_header<T>(start, fs::file_size(path), accept));
  });
}
}  // namespace

NumpyArray read_npy(const std::string& path, const AcceptShape& accept) {
  return with_header<float>(path, accept, [&](const ArrayHeader& header) {
    return array_of(header, read_text_file(path, kMaxArrayFileBytes));
  });
}

NumpyValues read_npy_values(const std::string& path, const AcceptShape& accept) {
  return with_header<double>(path, accept, [&](const ArrayHeader& header) {
    return NumpyValues{numbers_of<double>(header, read_text_file(path, kMaxArrayFileBytes)), header.kind() != 'f',
                       header.element_bytes()};
  });
}

std::vector<std::int64_t> npy_shape(const std::string& path) {
  return with_header<double>(path, {}, [](const ArrayHeader& header) { return header.shape; });
}

bool npy_is_whole(const std::string& path) {
  return with_header<double>(path, {}, [](const ArrayHeader& header) { return header.kind() != 'f'; });
}

namespace {
// `use` gets the checked header of an entry and its bytes; errors name the file and the entry.
template <class T, class Use>
auto with_entry(const std::string& path, std::string_view file, const ZipEntry& entry, const AcceptShape& accept,
                const Use& use) {
  try {
    const ArrayHeader header = checked_header<T>(zip_start(file, entry, kHeadBytes), entry.bytes, accept);
    return use(header, zip_contents(file, entry));
  } catch (const Error& e) {
    throw Error(e.kind(), e.code(), "'" + path + "', entry '" + key_of(entry.name) + "': " + e.message(), e.remedy());
  }
}
}  // namespace

NpzFile::NpzFile(std::string path) : path_(std::move(path)), file_(read_text_file(path_, kMaxArrayFileBytes)) {
  naming(path_, [&] { entries_ = zip_entries(file_); });
  for (const ZipEntry& entry : entries_) keys_.push_back(key_of(entry.name));
}

const ZipEntry& NpzFile::entry(const std::string& key) const {
  const auto at = std::find(keys_.begin(), keys_.end(), key);
  if (at == keys_.end())
    refuse_array("files.array.missing", "'" + path_ + "': no array '" + key + "' in it", "it has: " + join(keys_));
  return entries_[static_cast<std::size_t>(at - keys_.begin())];
}

NumpyArray NpzFile::read(const std::string& key, const AcceptShape& accept) const {
  return with_entry<float>(path_, file_, entry(key), accept, array_of);
}

NumpyNumbers<std::uint8_t> NpzFile::bytes(const std::string& key, const AcceptShape& accept) const {
  return with_entry<std::uint8_t>(path_, file_, entry(key), accept, numbers_of<std::uint8_t>);
}

NumpyNumbers<std::int64_t> NpzFile::whole(const std::string& key, const AcceptShape& accept) const {
  return with_entry<std::int64_t>(path_, file_, entry(key), accept, numbers_of<std::int64_t>);
}

std::string npy_header(const std::string& type, std::span<const std::int64_t> shape) {
  std::string axes;
  for (const std::int64_t axis : shape) axes += std::to_string(axis) + ", ";
  return npy_header(type, "(" + axes + ")");
}

std::string npy_header(const std::string& type, const std::string& axes) {
  std::string header = "{'descr': '" + type + "', 'fortran_order': False, 'shape': " + axes + ", }";
  header += std::string(63 - (header.size() + 10) % 64, ' ') + "\n";  // the data begins at a multiple of 64
  std::string out("\x93NUMPY\x01\x00", 8);
  out += static_cast<char>(header.size() & 0xFF);
  out += static_cast<char>(header.size() >> 8);
  return out + header;
}

}  // namespace semfield
