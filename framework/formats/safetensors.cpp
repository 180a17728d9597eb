// Writer and strict reader of the safetensors layout.
#include "formats/safetensors.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstring>
#include <nlohmann/json.hpp>
#include <optional>

#include "core/check.h"
#include "core/checksum.h"
#include "core/error.h"
#include "core/files.h"
#include "formats/text_rows.h"

namespace semfield {

static_assert(std::endian::native == std::endian::little, "the layout is little-endian");

namespace {

constexpr std::string_view kFileChecksum = "semfield.crc32c";
constexpr std::string_view kTensorChecksum = "semfield.crc32c:";
// The raw text before the file checksum's digits. Quotes inside a JSON string are escaped, so it cannot occur
// elsewhere.
constexpr std::string_view kChecksumMark = "\"semfield.crc32c\":\"";
constexpr std::string_view kNoDigits = "00000000";

std::string hex32(std::uint32_t value) { return fmt::format("{:08x}", value); }

std::span<const std::byte> as_byte_span(const char* data, std::size_t size) {
  return {reinterpret_cast<const std::byte*>(data), size};
}

// Product of the shape times the element size; none when it does not fit 63 bits.
std::optional<std::uint64_t> byte_count(const std::vector<std::int64_t>& shape, TensorType type) {
  std::int64_t product = static_cast<std::int64_t>(tensor_type_bytes(type));
  for (std::int64_t extent : shape) {
    if (extent < 0 || __builtin_mul_overflow(product, extent, &product)) return std::nullopt;
  }
  return static_cast<std::uint64_t>(product);
}

template <class T>
bool all_finite(std::span<const std::byte> bytes) {
  for (std::size_t i = 0; i + sizeof(T) <= bytes.size(); i += sizeof(T)) {
    T value;
    std::memcpy(&value, bytes.data() + i, sizeof(T));
    if (!std::isfinite(value)) return false;
  }
  return true;
}

}  // namespace

std::string_view tensor_type_name(TensorType type) {
  constexpr std::array<std::string_view, 4> kNames{"F32", "F64", "I64", "U8"};
  return kNames[static_cast<std::size_t>(type)];
}

std::size_t tensor_type_bytes(TensorType type) { return type == TensorType::u8 ? 1 : type == TensorType::f32 ? 4 : 8; }

std::string encode_safetensors(const std::vector<TensorRef>& tensors, const TensorMetadata& metadata) {
  // Wide elements first, so that without holes every tensor is aligned to its element.
  std::vector<const TensorRef*> order;
  for (const TensorRef& tensor : tensors) order.push_back(&tensor);
  std::stable_sort(order.begin(), order.end(), [](const TensorRef* a, const TensorRef* b) {
    return tensor_type_bytes(a->type) > tensor_type_bytes(b->type);
  });
  nlohmann::ordered_json header = nlohmann::ordered_json::object();
  nlohmann::ordered_json& meta = header["__metadata__"] = nlohmann::ordered_json::object();
  meta["semfield.crc32c"] = kNoDigits;
  for (const auto& [key, value] : metadata) {
    SEMFIELD_CHECK(!key.starts_with(kFileChecksum), "metadata key '" + key + "' is reserved for checksums");
    meta[key] = value;
  }
  std::uint64_t offset = 0;
  for (const TensorRef* tensor : order) {
    const std::optional<std::uint64_t> bytes = byte_count(tensor->shape, tensor->type);
    SEMFIELD_CHECK(bytes && *bytes == tensor->bytes.size(), "tensor '" + tensor->name + "' has the size of its shape");
    SEMFIELD_CHECK(!tensor->name.empty() && !header.contains(tensor->name),
                   "tensor name '" + tensor->name + "' is unique");
    header[tensor->name] = {{"dtype", std::string(tensor_type_name(tensor->type))},
                            {"shape", tensor->shape},
                            {"data_offsets", {offset, offset + *bytes}}};
    header["__metadata__"][std::string(kTensorChecksum) + tensor->name] = hex32(crc32c(tensor->bytes));
    offset += *bytes;
  }
  std::string text = header.dump();
  text.append((8 - text.size() % 8) % 8, ' ');

  std::string file(8, '\0');
  const std::uint64_t header_size = text.size();
  std::memcpy(file.data(), &header_size, 8);
  file.reserve(8 + text.size() + offset);
  file += text;
  for (const TensorRef* tensor : order)
    file.append(reinterpret_cast<const char*>(tensor->bytes.data()), tensor->bytes.size());
  const std::size_t digits = file.find(kChecksumMark) + kChecksumMark.size();
  const std::string checksum = hex32(crc32c(as_byte_span(file.data(), file.size())));
  file.replace(digits, checksum.size(), checksum);
  return file;
}

void write_safetensors(const std::string& path, const std::vector<TensorRef>& tensors, const TensorMetadata& metadata) {
  std::string image = encode_safetensors(tensors, metadata);
  AtomicFile file(path);
  file.append(std::as_bytes(std::span(image)));
  std::string().swap(image);  // the file is read back without a second copy in memory
  file.commit([&](const std::string& written) {
    try {
      (void)TensorFile::read(written);  // what was written is what a resume would read
    } catch (const Error& error) {
      throw Error(ErrorKind::io, "files.write.unreadable",
                  fmt::format("cannot write '{}': it does not read back ({})", path, error.message()),
                  "check the disk; training again from the last checkpoint may help");
    }
  });
}

/// One reading of one file: parse, check the layout, check the sums.
class TensorFileReader {
 public:
  TensorFileReader(std::string bytes, const std::string& name, const TensorFile::Limits& limits) : limits_(limits) {
    file_.bytes_ = std::make_unique<std::string>(std::move(bytes));
    file_.name_ = name;
  }

  TensorFile read() {
    const std::size_t data_begin = find_header();
    parse_header();
    lay_out(data_begin);
    check_sums();
    return std::move(file_);
  }

 private:
  [[noreturn]] void fail(const std::string& what) const {
    throw Error(ErrorKind::data, "checkpoint.file.damaged", fmt::format("'{}': {}", file_.name_, what),
                "the file is damaged or was not written here: use another checkpoint of the run");
  }

  std::size_t find_header() {
    const std::string& bytes = *file_.bytes_;
    if (bytes.size() < 8) fail(fmt::format("{} bytes are too few for a header", bytes.size()));
    std::uint64_t length = 0;
    std::memcpy(&length, bytes.data(), 8);
    if (length > limits_.header_bytes)
      fail(fmt::format("header length {} exceeds the limit of {} bytes", length, limits_.header_bytes));
    if (length > bytes.size() - 8) {
      fail(fmt::format("header length {} exceeds the file's {} bytes", length, bytes.size()));
    }
    header_ = std::string_view(bytes.data() + 8, static_cast<std::size_t>(length));
    return 8 + static_cast<std::size_t>(length);
  }

  void parse_header() {
    std::string duplicate;
    try {
      json_ = parse_json<nlohmann::json>(header_, duplicate, [](int depth) {
        if (depth > 4) throw Error(ErrorKind::data, "checkpoint.file.damaged", "nested too deeply");
      });
    } catch (const nlohmann::json::exception& error) {
      fail(fmt::format("the header is not JSON ({})", error.what()));
    } catch (const Error& error) {
      fail("the header is " + error.message());
    }
    if (!duplicate.empty()) fail(fmt::format("the key '{}' occurs twice in the header", duplicate));
    if (!json_.is_object()) fail("the header is not a JSON object");
  }

  void read_metadata(const nlohmann::json& meta) {
    if (!meta.is_object()) fail("__metadata__ is not a map of texts");
    for (const auto& [key, value] : meta.items()) {
      if (!value.is_string()) fail(fmt::format("metadata '{}' is not a text", key));
      (key.starts_with(kFileChecksum) ? sums_ : file_.metadata_)[key] = value.get<std::string>();
    }
  }

  std::uint64_t natural(const nlohmann::json& value, const std::string& tensor, const char* what) const {
    constexpr std::uint64_t kMost = std::uint64_t{1} << 62;
    if (!value.is_number_unsigned() || value.get<std::uint64_t>() > kMost) {
      fail(fmt::format("tensor '{}': {} holds {}, not a count", tensor, what, value.dump()));
    }
    return value.get<std::uint64_t>();
  }

  TensorType type_of(const std::string& tensor, const nlohmann::json& entry) const {
    const std::string text =
        entry.at("dtype").is_string() ? entry.at("dtype").get<std::string>() : entry.at("dtype").dump();
    for (TensorType type : {TensorType::f32, TensorType::f64, TensorType::i64, TensorType::u8}) {
      if (tensor_type_name(type) == text) return type;
    }
    fail(fmt::format("tensor '{}': dtype '{}' is none of F32, F64, I64, U8", tensor, text));
  }

  void lay_out(std::size_t data_begin) {
    struct Placed {
      TensorRef tensor;
      std::uint64_t begin = 0, end = 0;
    };
    std::vector<Placed> placed;
    for (const auto& [name, entry] : json_.items()) {
      if (name == "__metadata__") {
        read_metadata(entry);
        continue;
      }
      if (!entry.is_object() || entry.size() != 3 || !entry.contains("dtype") || !entry.contains("shape") ||
          !entry.contains("data_offsets") || !entry["shape"].is_array() || !entry["data_offsets"].is_array() ||
          entry["data_offsets"].size() != 2) {
        fail(fmt::format("tensor '{}' lacks dtype, shape or two data_offsets, or has more", name));
      }
      Placed p;
      p.tensor.name = name;
      p.tensor.type = type_of(name, entry);
      p.begin = natural(entry["data_offsets"][0], name, "data_offsets");
      p.end = natural(entry["data_offsets"][1], name, "data_offsets");
      for (const nlohmann::json& extent : entry["shape"]) {
        p.tensor.shape.push_back(static_cast<std::int64_t>(natural(extent, name, "shape")));
      }
      const std::optional<std::uint64_t> bytes = byte_count(p.tensor.shape, p.tensor.type);
      if (!bytes) fail(fmt::format("tensor '{}': the product of its shape overflows", name));
      if (p.end < p.begin || p.end - p.begin != *bytes) {
        fail(fmt::format("tensor '{}': offsets [{}, {}) do not hold the {} bytes of its shape", name, p.begin, p.end,
                         *bytes));
      }
      placed.push_back(std::move(p));
    }
    std::stable_sort(placed.begin(), placed.end(), [](const Placed& a, const Placed& b) {
      return a.begin != b.begin ? a.begin < b.begin : a.end < b.end;
    });
    const std::uint64_t data_size = file_.bytes_->size() - data_begin;
    std::uint64_t expected = 0;
    for (Placed& p : placed) {
      if (p.begin != expected) {
        fail(fmt::format("tensor '{}' starts at byte {}, {} byte {}", p.tensor.name, p.begin,
                         p.begin < expected ? "overlapping the one that ends at" : "leaving a hole after", expected));
      }
      if (p.end > data_size) {
        fail(fmt::format("tensor '{}' ends at byte {} of {} that are there: the file is cut short", p.tensor.name,
                         p.end, data_size));
      }
      p.tensor.bytes =
          as_byte_span(file_.bytes_->data() + data_begin + p.begin, static_cast<std::size_t>(p.end - p.begin));
      expected = p.end;
      file_.tensors_.push_back(std::move(p.tensor));
    }
    if (expected != data_size)
      fail(fmt::format("{} bytes behind the last tensor belong to none", data_size - expected));
  }

  void check_sums() const {
    for (const TensorRef& tensor : file_.tensors_) {
      const auto sum = sums_.find(std::string(kTensorChecksum) + tensor.name);
      if (sum == sums_.end()) {
        if (limits_.require_checksums) fail(fmt::format("tensor '{}' has no checksum", tensor.name));
      } else if (sum->second != hex32(crc32c(tensor.bytes))) {
        fail(fmt::format("tensor '{}' does not match its checksum", tensor.name));
      }
    }
    check_file_sum();
    if (!limits_.refuse_nonfinite) return;
    for (const TensorRef& tensor : file_.tensors_) {
      if ((tensor.type == TensorType::f32 && !all_finite<float>(tensor.bytes)) ||
          (tensor.type == TensorType::f64 && !all_finite<double>(tensor.bytes))) {
        fail(fmt::format("tensor '{}' holds NaN or infinity", tensor.name));
      }
    }
  }

  void check_file_sum() const {
    const auto stored = sums_.find(std::string(kFileChecksum));
    if (stored == sums_.end()) {
      if (limits_.require_checksums) fail("the file has no checksum");
      return;
    }
    const std::size_t mark = header_.find(kChecksumMark);
    if (mark == std::string_view::npos || stored->second.size() != kNoDigits.size())
      fail("the file's checksum is not readable");
    const std::size_t digits = 8 + mark + kChecksumMark.size();
    const std::size_t rest = digits + kNoDigits.size();
    const std::string& bytes = *file_.bytes_;
    if (rest > bytes.size()) fail("the file's checksum is not readable");
    std::uint32_t sum = crc32c(as_byte_span(bytes.data(), digits));
    sum = crc32c(as_byte_span(kNoDigits.data(), kNoDigits.size()), sum);
    sum = crc32c(as_byte_span(bytes.data() + rest, bytes.size() - rest), sum);
    if (stored->second != hex32(sum)) fail("the header does not match the file's checksum");
  }

  TensorFile file_;
  TensorFile::Limits limits_;
  std::string_view header_;
  nlohmann::json json_;
  TensorMetadata sums_;
};

TensorFile TensorFile::read(const std::string& path, const Limits& limits) {
  return decode(read_text_file(path, limits.file_bytes), path, limits);
}

TensorFile TensorFile::decode(std::string bytes, const std::string& name, const Limits& limits) {
  return TensorFileReader(std::move(bytes), name, limits).read();
}

const TensorRef* TensorFile::find(std::string_view name) const {
  for (const TensorRef& tensor : tensors_) {
    if (tensor.name == name) return &tensor;
  }
  return nullptr;
}

const TensorRef& TensorFile::require(std::string_view name, TensorType type, std::int64_t count) const {
  const TensorRef* tensor = find(name);
  const std::string remedy = "the checkpoint belongs to another configuration: use the run's own run.yaml";
  if (tensor == nullptr)
    throw Error(ErrorKind::data, "checkpoint.tensor.missing", fmt::format("'{}' has no tensor '{}'", name_, name),
                remedy);
  const auto elements = static_cast<std::int64_t>(tensor->bytes.size() / tensor_type_bytes(tensor->type));
  if (tensor->type != type || elements != count) {
    throw Error(ErrorKind::data, "checkpoint.tensor.shape",
                fmt::format("'{}': tensor '{}' is {} elements of {}, expected {} of {}", name_, name, elements,
                            tensor_type_name(tensor->type), count, tensor_type_name(type)),
                remedy);
  }
  return *tensor;
}

template <class T>
std::vector<T> TensorFile::values_of(std::string_view name, std::int64_t count) const {
  const TensorRef& tensor = require(name, tensor_type_of<T>(), count);
  std::vector<T> values(static_cast<std::size_t>(count));
  if (count > 0) std::memcpy(values.data(), tensor.bytes.data(), tensor.bytes.size());
  return values;
}
std::vector<float> TensorFile::floats(std::string_view name, std::int64_t count) const {
  return values_of<float>(name, count);
}
std::vector<std::int64_t> TensorFile::integers(std::string_view name, std::int64_t count) const {
  return values_of<std::int64_t>(name, count);
}

}  // namespace semfield
