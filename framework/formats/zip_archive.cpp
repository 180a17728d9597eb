#include "formats/zip_archive.h"

#include <zlib.h>

#include <algorithm>
#include <bit>
#include <cstring>
#include <new>

#include "core/error.h"
#include "core/files.h"

namespace semfield {

namespace {

constexpr std::uint64_t kMaxRatio = 1032;  // what deflate can reach at most
constexpr std::uint64_t kMaxArchiveBytes = std::uint64_t{2} << 30;
constexpr std::uint32_t kLocal = 0x04034b50, kCentral = 0x02014b50, kEnd = 0x06054b50, kEnd64 = 0x06064b50,
                        kLocator64 = 0x07064b50;
constexpr std::uint32_t kSee64 = 0xFFFFFFFFu;  // "the ZIP64 field has it"

[[noreturn]] void refuse_zip(const std::string& message, const std::string& remedy = {}) {
  throw Error(ErrorKind::data, "files.zip.damaged", message, remedy);
}

template <class T>
T little(std::string_view bytes, std::size_t at) {
  static_assert(std::endian::native == std::endian::little);
  if (bytes.size() < sizeof(T) || at > bytes.size() - sizeof(T)) refuse_zip("the file ends too early", kSaveAgain);
  T value;
  std::memcpy(&value, bytes.data() + at, sizeof value);
  return value;
}

// ZIP64 sizes of an entry, in the fixed order of those fields that say so.
void widen(ZipEntry& entry, std::string_view extra) {
  while (extra.size() >= 4) {
    const auto id = little<std::uint16_t>(extra, 0), size = little<std::uint16_t>(extra, 2);
    if (size > extra.size() - 4) return;
    if (id == 1) {
      std::size_t at = 4;
      for (std::uint64_t* field : {&entry.bytes, &entry.packed_bytes, &entry.local_at}) {
        if (*field != kSee64) continue;
        *field = little<std::uint64_t>(extra.substr(0, std::size_t{4} + size), at);
        at += 8;
      }
      return;
    }
    extra.remove_prefix(std::size_t{4} + size);
  }
}

// The first `wanted` of `bytes`.
std::string inflated(std::string_view packed, std::uint64_t bytes, std::uint64_t wanted) {
  if (bytes / kMaxRatio > packed.size() + 1)
    refuse_zip("it claims to hold " + std::to_string(bytes) + " bytes, more than its " + std::to_string(packed.size()) +
                   " packed ones can be",
               kSaveAgain);
  std::string out(wanted, '\0');
  z_stream stream{};
  const int started = inflateInit2(&stream, -MAX_WBITS);
  if (started == Z_MEM_ERROR) throw std::bad_alloc();
  if (started != Z_OK) throw Error(ErrorKind::internal, "memory.zlib.failed", "zlib cannot start");
  stream.next_in = reinterpret_cast<Bytef*>(const_cast<char*>(packed.data()));
  stream.next_out = reinterpret_cast<Bytef*>(out.data());
  std::size_t left_in = packed.size(), left_out = out.size();
  int status = Z_OK;
  while (status == Z_OK && (left_out > 0 || wanted == bytes)) {  // zlib counts in 32 bits
    const auto in = static_cast<uInt>(std::min<std::size_t>(left_in, 1u << 30)),
               room = static_cast<uInt>(std::min<std::size_t>(left_out, 1u << 30));
    stream.avail_in = in;
    stream.avail_out = room;
    status = inflate(&stream, Z_NO_FLUSH);
    left_in -= in - stream.avail_in;
    left_out -= room - stream.avail_out;
  }
  inflateEnd(&stream);
  if (status == Z_MEM_ERROR) throw std::bad_alloc();
  if ((status != Z_STREAM_END && wanted == bytes) || left_out != 0)
    refuse_zip("its packed data are damaged or cut off", kSaveAgain);
  return out;
}

std::uint32_t crc_of(std::string_view bytes) {
  return static_cast<std::uint32_t>(crc32_z(0, reinterpret_cast<const Bytef*>(bytes.data()), bytes.size()));
}

std::string deflated(const std::string& bytes) {
  z_stream stream{};
  if (deflateInit2(&stream, 6, Z_DEFLATED, -MAX_WBITS, 8, Z_DEFAULT_STRATEGY) != Z_OK)
    throw Error(ErrorKind::internal, "memory.zlib.failed", "zlib cannot start");
  std::string out(deflateBound(&stream, bytes.size()), '\0');
  stream.next_in = reinterpret_cast<Bytef*>(const_cast<char*>(bytes.data()));
  stream.avail_in = static_cast<uInt>(bytes.size());
  stream.next_out = reinterpret_cast<Bytef*>(out.data());
  stream.avail_out = static_cast<uInt>(out.size());
  const int status = deflate(&stream, Z_FINISH);
  out.resize(stream.total_out);
  deflateEnd(&stream);
  if (status != Z_STREAM_END) throw Error(ErrorKind::internal, "memory.zlib.failed", "zlib cannot pack");
  return out;
}

void put(std::string& out, std::uint64_t value, int bytes) {
  for (int i = 0; i < bytes; ++i) out += static_cast<char>((value >> (8 * i)) & 0xFF);
}

// What local header and directory say alike, from "version needed" to the length of the extra field.
std::string common_fields(const ZipEntry& entry) {
  std::string out;
  put(out, 20, 2);
  put(out, 0, 2);
  put(out, entry.method, 2);
  put(out, 0x00210000, 4);  // 1980-01-01 00:00, the first time that the format knows
  put(out, entry.crc, 4);
  put(out, entry.packed_bytes, 4);
  put(out, entry.bytes, 4);
  put(out, entry.name.size(), 2);
  put(out, 0, 2);
  return out;
}

}  // namespace

std::vector<ZipEntry> zip_entries(std::string_view file) {
  // The end record stands last, but for a comment of at most 65,535 bytes.
  std::size_t end = std::string_view::npos;
  const std::size_t lowest = file.size() > 65557 ? file.size() - 65557 : 0;
  for (std::size_t at = file.size() < 22 ? lowest : file.size() - 21; file.size() >= 22 && at-- > lowest;) {
    if (little<std::uint32_t>(file, at) == kEnd) {
      end = at;
      break;
    }
  }
  if (end == std::string_view::npos) refuse_zip("not a zip archive: its end is missing", kSaveAgain);
  std::uint64_t count = little<std::uint16_t>(file, end + 10), at = little<std::uint32_t>(file, end + 16);
  if (end >= 20 && little<std::uint32_t>(file, end - 20) == kLocator64) {
    const auto end64 = little<std::uint64_t>(file, end - 12);
    if (end64 > file.size() || little<std::uint32_t>(file, end64) != kEnd64)
      refuse_zip("the archive's directory cannot be found", kSaveAgain);
    count = little<std::uint64_t>(file, end64 + 32);
    at = little<std::uint64_t>(file, end64 + 48);
  }
  std::vector<ZipEntry> entries;
  for (; count > 0; --count) {
    if (at > file.size() || little<std::uint32_t>(file, at) != kCentral)
      refuse_zip("entry " + std::to_string(entries.size() + 1) + " of the archive's directory is damaged", kSaveAgain);
    const auto flags = little<std::uint16_t>(file, at + 8);
    const auto name = little<std::uint16_t>(file, at + 28), extra = little<std::uint16_t>(file, at + 30),
               comment = little<std::uint16_t>(file, at + 32);
    const std::uint64_t rest = at + 46;
    if (rest + name + extra + comment > file.size())
      refuse_zip("the archive's directory runs past the end", kSaveAgain);
    ZipEntry entry{std::string(file.substr(rest, name)), little<std::uint16_t>(file, at + 10),
                   little<std::uint32_t>(file, at + 16), little<std::uint32_t>(file, at + 20),
                   little<std::uint32_t>(file, at + 24), little<std::uint32_t>(file, at + 42)};
    if ((flags & 1) != 0) refuse_zip("entry '" + entry.name + "' is encrypted");
    widen(entry, file.substr(rest + name, extra));
    entries.push_back(std::move(entry));
    at = rest + name + extra + comment;
  }
  // Of entries that share bytes, each unpacks them again: a small file would hold any amount.
  std::vector<const ZipEntry*> in_order;
  for (const ZipEntry& entry : entries) in_order.push_back(&entry);
  std::sort(in_order.begin(), in_order.end(),
            [](const ZipEntry* a, const ZipEntry* b) { return a->local_at < b->local_at; });
  for (std::size_t i = 1; i < in_order.size(); ++i) {
    const ZipEntry& before = *in_order[i - 1];
    if (in_order[i]->local_at - before.local_at < before.packed_bytes)
      refuse_zip("the entries '" + before.name + "' and '" + in_order[i]->name + "' overlap", kSaveAgain);
  }
  return entries;
}

std::string zip_start(std::string_view file, const ZipEntry& entry, std::uint64_t bytes) {
  if (entry.local_at > file.size() || little<std::uint32_t>(file, entry.local_at) != kLocal)
    refuse_zip("its header is not where the directory says", kSaveAgain);
  const std::uint64_t start = entry.local_at + 30 + little<std::uint16_t>(file, entry.local_at + 26) +
                              little<std::uint16_t>(file, entry.local_at + 28);
  if (start > file.size() || entry.packed_bytes > file.size() - start)
    refuse_zip("it runs past the end of the file", kSaveAgain);
  const std::string_view packed = file.substr(start, entry.packed_bytes);
  const std::uint64_t wanted = std::min(bytes, entry.bytes);
  if (entry.method == 0) {
    if (entry.bytes != entry.packed_bytes) refuse_zip("its two sizes differ though it is not packed", kSaveAgain);
    return std::string(packed.substr(0, wanted));
  }
  if (entry.method == 8) return inflated(packed, entry.bytes, wanted);
  refuse_zip("compression method " + std::to_string(entry.method) + " is not read",
             "save it with numpy.savez or numpy.savez_compressed");
}

std::string zip_contents(std::string_view file, const ZipEntry& entry) {
  std::string out = zip_start(file, entry, entry.bytes);
  if (crc_of(out) != entry.crc) refuse_zip("its checksum is wrong", kSaveAgain);
  return out;
}

void ZipWriter::add(const std::string& name, const std::string& bytes) {
  if (bytes.size() + out_.size() > kMaxArchiveBytes)
    throw Error(ErrorKind::data, "files.zip.size", "'" + path_ + "' would be larger than 2 GiB", "write less a file");
  const std::string packed = deflated(bytes);
  const ZipEntry entry{name, 8, crc_of(bytes), packed.size(), bytes.size(), out_.size()};
  const std::string fields = common_fields(entry);
  put(out_, kLocal, 4);
  out_ += fields + entry.name + packed;
  put(directory_, kCentral, 4);
  put(directory_, 20, 2);
  directory_ += fields;
  put(directory_, 0, 8);  // no comment, first disk, no attributes
  put(directory_, 0, 2);
  put(directory_, entry.local_at, 4);
  directory_ += entry.name;
  ++count_;
}

void ZipWriter::write() {
  const std::size_t start = out_.size();
  out_ += directory_;
  put(out_, kEnd, 4);
  put(out_, 0, 4);
  put(out_, count_, 2);
  put(out_, count_, 2);
  put(out_, directory_.size(), 4);
  put(out_, start, 4);
  put(out_, 0, 2);
  write_file_atomic(path_, out_);
}

}  // namespace semfield
