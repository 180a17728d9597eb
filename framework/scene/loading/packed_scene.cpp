// Packed scenes: writer and reader.
#include "scene/loading/packed_scene.h"

#include <fmt/format.h>
#include <sys/stat.h>
#include <unistd.h>
#include <zlib.h>

#include <algorithm>
#include <bit>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <new>
#include <span>
#include <utility>

#include "core/checksum.h"
#include "formats/image_io.h"

namespace semfield {

static_assert(std::endian::native == std::endian::little,
              "packed scenes are written in the machine's order, which must be little-endian");

namespace {

constexpr char kMagic[8] = {'S', 'E', 'M', 'F', 'P', 'A', 'C', 'K'};
constexpr std::size_t kHeaderBytes = 64;
constexpr std::uint64_t kMaxManifestBytes = std::uint64_t{1} << 30;
constexpr std::uint32_t kDeflated = 1, kMillimetres = 2;
constexpr const char* kChannelNames[] = {"colour", "depth", "label", "instance", "mask", "alpha"};

using Chunks = std::array<PackedScene::Chunk, PackedScene::kChannels>;

// Manifest fields in order; one walk for both directions, so writer and reader cannot disagree.
class Writer {
 public:
  template <class T>
  void number(T& value) {
    const auto* p = reinterpret_cast<const std::byte*>(&value);
    bytes.insert(bytes.end(), p, p + sizeof(T));
  }
  void text(std::string& value) {
    auto size = static_cast<std::uint32_t>(value.size());
    number(size);
    const auto* p = reinterpret_cast<const std::byte*>(value.data());
    bytes.insert(bytes.end(), p, p + value.size());
  }
  template <class T>
  void list(std::vector<T>& values, std::size_t) {
    auto size = static_cast<std::uint32_t>(values.size());
    number(size);
  }
  /// Whether more follows; a reader asks what is left.
  static bool goes_on() { return false; }
  std::vector<std::byte> bytes;
};

class Reader {
 public:
  explicit Reader(std::span<const std::byte> bytes) : left_(bytes) {}
  template <class T>
  void number(T& value) {
    take(&value, sizeof(T));
  }
  void text(std::string& value) {
    std::uint32_t size = 0;
    number(size);
    need(size);
    value.assign(reinterpret_cast<const char*>(left_.data()), size);
    left_ = left_.subspan(size);
  }
  template <class T>
  void list(std::vector<T>& values, std::size_t least_bytes) {
    std::uint32_t size = 0;
    number(size);
    need(std::size_t{size} * least_bytes);  // a count that the bytes left cannot hold allocates nothing
    values.resize(size);
  }
  bool finished() const { return left_.empty(); }
  bool goes_on() const { return !finished(); }

 private:
  void need(std::size_t size) const {
    if (size > left_.size())
      throw Error(ErrorKind::data, "scene.packed.damaged", "manifest ends early", "pack the scene again");
  }
  void take(void* to, std::size_t size) {
    need(size);
    std::memcpy(to, left_.data(), size);
    left_ = left_.subspan(size);
  }
  std::span<const std::byte> left_;
};

template <class Stream>
void flags(Stream& s, std::initializer_list<bool*> bits) {
  std::uint8_t byte = 0;
  unsigned at = 0;
  for (const bool* bit : bits) byte = static_cast<std::uint8_t>(byte | (*bit ? 1u : 0u) << at++);
  s.number(byte);
  at = 0;
  for (bool* bit : bits) *bit = (byte >> at++ & 1u) != 0;
}

template <class Stream, class... Number>
void numbers(Stream& s, Number&... values) {
  (s.number(values), ...);
}

template <class Stream>
void vector3(Stream& s, Vec3d& v) {
  numbers(s, v.x, v.y, v.z);
}

// A number of an enumeration up to `last`.
template <class Stream, class Enum>
void choice(Stream& s, Enum& value, Enum last, const char* what) {
  auto number = static_cast<std::uint8_t>(value);
  s.number(number);
  if (number > static_cast<std::uint8_t>(last))
    throw Error(ErrorKind::data, "scene.packed.damaged", std::string("manifest has an unknown ") + what,
                "pack the scene again");
  value = static_cast<Enum>(number);
}

template <class Stream>
void walk_frame(Stream& s, std::uint32_t version, FrameInfo& f, Chunks& chunks) {
  s.text(f.name);
  s.text(f.source);
  Camera& c = f.camera;
  numbers(s, c.width_px, c.height_px, c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.k3, c.k4, c.p1, c.p2);
  if (version > 1) choice(s, c.lens, LensKind::equirectangular, "lens");
  if (version > 2) {
    auto orientation = static_cast<std::uint8_t>(f.orientation);
    s.number(orientation);
    if (orientation < 1 || orientation > 8)
      throw Error(ErrorKind::data, "scene.packed.damaged", "manifest has an unknown orientation",
                  "pack the scene again");
    f.orientation = orientation;
  }
  for (auto& [x, y, z] : f.world_from_camera.r) numbers(s, x, y, z);
  vector3(s, f.world_from_camera.t);
  choice(s, f.split, Split::unused, "split");
  for (std::size_t i = 0; i < (version > 1 ? PackedScene::kChannels : PackedScene::kUsed); ++i) {
    PackedScene::Chunk& k = chunks[i];
    numbers(s, k.offset, k.stored_bytes, k.raw_bytes, k.crc, k.format);
  }
}

template <class Stream>
void walk(Stream& s, std::uint32_t version, SceneInfo& info, std::vector<ClassEntry>& classes,
          std::vector<Chunks>& chunks) {
  s.text(info.name);
  flags(s, {&info.metric, &info.opengl_files, &info.tracked});
  numbers(s, info.near_hint_m, info.far_hint_m);
  vector3(s, info.bounds.lo);
  vector3(s, info.bounds.hi);
  s.list(classes, 12);
  for (ClassEntry& e : classes) {
    s.number(e.id);
    s.text(e.name);
    numbers(s, e.color[0], e.color[1], e.color[2]);
    flags(s, {&e.ignore});
  }
  s.list(info.frames, 200);
  chunks.resize(info.frames.size());
  for (std::size_t i = 0; i < info.frames.size(); ++i) walk_frame(s, version, info.frames[i], chunks[i]);
  if (s.goes_on()) {  // a box that guessed bounds were once kept to
    Box limit;
    vector3(s, limit.lo);
    vector3(s, limit.hi);
  }
}

template <class T>
std::span<const std::byte> raw_bytes(const std::vector<T>& values) {
  return std::as_bytes(std::span<const T>(values));
}

PackedScene::Chunk put_chunk(AtomicFile& file, std::span<const std::byte> raw, std::uint32_t format) {
  PackedScene::Chunk chunk;
  if (raw.empty()) return chunk;
  uLongf packed_bytes = ::compressBound(static_cast<uLong>(raw.size()));
  std::vector<std::byte> packed(packed_bytes);
  const int status = ::compress2(reinterpret_cast<Bytef*>(packed.data()), &packed_bytes,
                                 reinterpret_cast<const Bytef*>(raw.data()), static_cast<uLong>(raw.size()), 3);
  const bool smaller = status == Z_OK && packed_bytes < raw.size();
  const std::span<const std::byte> stored = smaller ? std::span<const std::byte>(packed.data(), packed_bytes) : raw;
  chunk = {file.size(), stored.size(), raw.size(), crc32c(stored), format | (smaller ? kDeflated : 0u)};
  file.append(stored);
  return chunk;
}

// Whether whole millimetres hold all depth of a frame: a scene may be in any unit.
bool fits_millimetres(const std::vector<float>& depth_m) {
  return std::all_of(depth_m.begin(), depth_m.end(), [](float d) {
    const double mm = std::round(static_cast<double>(d) * 1000.0);
    return !(d > 0) || (mm < 65535 && std::abs(mm - static_cast<double>(d) * 1000.0) <= static_cast<double>(d));
  });
}

std::vector<std::uint16_t> millimetres(const std::vector<float>& depth_m) {
  std::vector<std::uint16_t> out(depth_m.size());
  for (std::size_t i = 0; i < out.size(); ++i)
    out[i] = depth_m[i] > 0 ? static_cast<std::uint16_t>(std::lround(static_cast<double>(depth_m[i]) * 1000.0)) : 0;
  return out;
}

struct Header {
  char magic[8];
  std::uint32_t version, frames;
  std::uint64_t file_bytes, manifest_offset, manifest_bytes;
  std::uint32_t manifest_crc, zero[4], header_crc;
};
static_assert(sizeof(Header) == kHeaderBytes);

std::span<const std::byte> bytes_of(const Header& h) { return std::as_bytes(std::span<const Header, 1>(&h, 1)); }
std::uint32_t crc_of(const Header& h) { return crc32c(bytes_of(h).first(kHeaderBytes - 4)); }

// Reads exactly out.size() bytes or tells why not.
void read_at(int file, std::uint64_t offset, std::span<std::byte> out) {
  while (!out.empty()) {
    const ssize_t got = ::pread(file, out.data(), out.size(), static_cast<off_t>(offset));
    if (got < 0 && errno == EINTR) continue;
    if (got <= 0)
      throw Error(
          ErrorKind::io, "files.read.failed",
          got < 0 ? std::string("cannot read: ") + std::strerror(errno) : "file became shorter while it was read");
    out = out.subspan(static_cast<std::size_t>(got));
    offset += static_cast<std::uint64_t>(got);
  }
}

bool has_magic(const std::string& head) { return head.starts_with(std::string_view(kMagic, sizeof kMagic)); }

template <class T>
std::vector<T> typed(const std::vector<std::byte>& bytes) {
  std::vector<T> out(bytes.size() / sizeof(T));
  if (!out.empty())
    std::memcpy(out.data(), bytes.data(), out.size() * sizeof(T));  // memcpy wants no null, even for nothing
  return out;
}

}  // namespace

void write_packed_scene(const std::string& path, const SceneInfo& info,
                        const std::function<void(int, FrameBuffer&)>& read, bool depth_as_mm) {
  AtomicFile file(path);
  Header header{};
  file.append(bytes_of(header));
  std::vector<Chunks> chunks(info.frames.size());
  FrameBuffer frame;
  for (std::size_t i = 0; i < info.frames.size(); ++i) {
    frame = {};
    read(static_cast<int>(i), frame);
    chunks[i][PackedScene::kColor] = put_chunk(file, raw_bytes(frame.rgb), 0);
    if (depth_as_mm && fits_millimetres(frame.depth_m)) {
      chunks[i][PackedScene::kDepth] = put_chunk(file, raw_bytes(millimetres(frame.depth_m)), kMillimetres);
    } else {
      chunks[i][PackedScene::kDepth] = put_chunk(file, raw_bytes(frame.depth_m), 0);
    }
    chunks[i][PackedScene::kLabel] = put_chunk(file, raw_bytes(frame.label), 0);
    chunks[i][PackedScene::kUsed] = put_chunk(file, raw_bytes(frame.used), 0);
    chunks[i][PackedScene::kInstance] = put_chunk(file, raw_bytes(frame.instance), 0);
    for (const FrameChannel& one : frame.channels)
      if (one.name == kAlphaChannel) chunks[i][PackedScene::kAlpha] = put_chunk(file, raw_bytes(alpha_bytes(one)), 0);
  }
  SceneInfo copy = info;
  std::vector<ClassEntry> classes = info.classes.entries();
  Writer manifest;
  header.version = 1;
  for (std::size_t i = 0; i < chunks.size(); ++i) {
    const FrameInfo& f = info.frames[i];
    const bool masked = chunks[i][PackedScene::kUsed].raw_bytes > 0,
               alpha = chunks[i][PackedScene::kAlpha].raw_bytes > 0;
    if (masked || alpha || f.camera.is_wide()) header.version = std::max(header.version, 2u);
    if (f.orientation != 1) header.version = kPackedVersion;
  }
  walk(manifest, header.version, copy, classes, chunks);
  std::memcpy(header.magic, kMagic, sizeof kMagic);
  header.frames = static_cast<std::uint32_t>(info.frames.size());
  header.manifest_offset = file.size();
  header.manifest_bytes = manifest.bytes.size();
  header.manifest_crc = crc32c(manifest.bytes);
  file.append(manifest.bytes);
  header.file_bytes = file.size();
  header.header_crc = crc_of(header);
  file.overwrite(0, bytes_of(header));
  file.commit();
}

bool is_packed_scene(const std::string& path) { return has_magic(read_file_start(path, sizeof kMagic)); }

PackedScene::PackedScene(std::string path) : path_(std::move(path)) {
  const auto refuse = [&](Code code, const std::string& what, const std::string& remedy) -> Error {
    return Error(ErrorKind::data, code, "'" + path_ + "': " + what, remedy);
  };
  const std::string again = "pack the scene again";
  const std::string head = read_file_start(path_, kHeaderBytes);
  Header header{};
  if (!has_magic(head))
    throw refuse("scene.packed.format", "not a packed scene", "give a file that 'semfield pack' wrote");
  if (head.size() < kHeaderBytes)
    throw refuse("scene.packed.damaged", "truncated inside its header", "copy the file again");
  std::memcpy(&header, head.data(), kHeaderBytes);
  if (crc_of(header) != header.header_crc)
    throw refuse("scene.packed.damaged", "header is damaged (wrong checksum)", "copy the file again");
  if (header.version < 1 || header.version > kPackedVersion)
    throw refuse("scene.packed.version",
                 fmt::format("format version {}; this build reads versions up to {}", header.version, kPackedVersion),
                 again);
  file_ = open_for_reading(path_);
  struct stat about {};
  naming(path_, [&] {
    if (::fstat(file_, &about) != 0)
      throw refuse("files.read.failed", std::string("cannot read: ") + std::strerror(errno), "check the disk");
    file_bytes_ = static_cast<std::uint64_t>(about.st_size);
    if (file_bytes_ != header.file_bytes)
      throw refuse("scene.packed.damaged",
                   fmt::format("holds {} bytes, its header says {}", file_bytes_, header.file_bytes),
                   "copy the file again");
    if (header.manifest_bytes > kMaxManifestBytes || header.manifest_offset > file_bytes_ ||
        header.manifest_bytes > file_bytes_ - header.manifest_offset)
      throw refuse("scene.packed.damaged", "manifest lies outside the file", again);
    std::vector<std::byte> manifest(header.manifest_bytes);
    read_at(file_, header.manifest_offset, manifest);
    if (crc32c(manifest) != header.manifest_crc)
      throw refuse("scene.packed.damaged", "manifest is damaged (wrong checksum)", "copy the file again");
    Reader reader(manifest);
    std::vector<ClassEntry> classes;
    walk(reader, header.version, info_, classes, chunks_);
    if (!reader.finished() || info_.frames.size() != header.frames)
      throw refuse("scene.packed.damaged", "manifest does not match its header", again);
    info_.classes = ClassTable(std::move(classes));
    static constexpr std::uint64_t kPixelBytes[kChannels] = {3, 4, 2, 4, 1, 1};
    for (std::size_t i = 0; i < info_.frames.size(); ++i) {
      FrameInfo& f = info_.frames[i];
      check_image_limits(f.camera.width_px, f.camera.height_px);
      const std::uint64_t pixels = pixel_at(0, f.camera.height_px, f.camera.width_px);
      for (std::size_t c = 0; c < kChannels; ++c) {
        const Chunk& k = chunks_[i][c];
        const std::uint64_t expected =
            c == kDepth && (k.format & kMillimetres) != 0 ? pixels * 2 : pixels * kPixelBytes[c];
        const bool fits = k.offset <= file_bytes_ && k.stored_bytes <= file_bytes_ - k.offset;
        const bool sized =
            k.raw_bytes == expected &&
            ((k.format & kDeflated) != 0 ? k.raw_bytes / 1032 <= k.stored_bytes : k.stored_bytes == k.raw_bytes);
        if (k.raw_bytes == 0 ? c == kColor : !fits || !sized)
          throw refuse("scene.packed.damaged",
                       fmt::format("frame '{}': {} has an impossible size", f.name, kChannelNames[c]), again);
      }
      f.has_depth = chunks_[i][kDepth].raw_bytes > 0;
      f.has_labels = chunks_[i][kLabel].raw_bytes > 0;
      f.has_instances = chunks_[i][kInstance].raw_bytes > 0;
      if (chunks_[i][kAlpha].raw_bytes > 0) f.channels.push_back(alpha_info(f.camera));
    }
  });
}

std::vector<std::byte> PackedScene::chunk_bytes(int frame, Channel channel) const {
  const Chunk& chunk = chunks_[static_cast<std::size_t>(frame)][channel];
  const auto fail = [&](const char* what) {
    return Error(ErrorKind::data, "scene.packed.damaged",
                 fmt::format("'{}': frame '{}': {}{}", path_, info_.frames[static_cast<std::size_t>(frame)].name,
                             kChannelNames[channel], what),
                 "copy the file again, or pack the scene again");
  };
  if (chunk.raw_bytes == 0) return {};
  std::vector<std::byte> stored(chunk.stored_bytes);
  read_at(file_, chunk.offset, stored);
  if (crc32c(stored) != chunk.crc) throw fail(" is damaged (wrong checksum)");
  if ((chunk.format & kDeflated) == 0) return stored;
  std::vector<std::byte> raw(chunk.raw_bytes);
  uLongf made = static_cast<uLongf>(raw.size());
  const int status = ::uncompress(reinterpret_cast<Bytef*>(raw.data()), &made,
                                  reinterpret_cast<const Bytef*>(stored.data()), static_cast<uLong>(stored.size()));
  if (status == Z_MEM_ERROR) throw std::bad_alloc();  // the file may be whole
  if (status != Z_OK || made != raw.size()) throw fail(" cannot be inflated");
  return raw;
}

void PackedScene::read(int frame, FrameBuffer& out) const {
  const std::vector<std::string> wanted = std::move(out.wanted);
  out = {};
  const FrameInfo& info = info_.frames.at(static_cast<std::size_t>(frame));
  out.width_px = info.camera.width_px;
  out.height_px = info.camera.height_px;
  out.rgb = typed<std::uint8_t>(chunk_bytes(frame, kColor));
  const std::vector<std::byte> depth = chunk_bytes(frame, kDepth);
  if ((chunks_[static_cast<std::size_t>(frame)][kDepth].format & kMillimetres) != 0) {
    for (const std::uint16_t mm : typed<std::uint16_t>(depth)) out.depth_m.push_back(static_cast<float>(mm * 0.001));
  } else {
    out.depth_m = typed<float>(depth);
  }
  out.label = typed<std::int16_t>(chunk_bytes(frame, kLabel));
  out.instance = typed<std::int32_t>(chunk_bytes(frame, kInstance));
  out.used = typed<std::uint8_t>(chunk_bytes(frame, kUsed));
  if (!info.channels.empty() && std::find(wanted.begin(), wanted.end(), kAlphaChannel) != wanted.end())
    out.channels.push_back(alpha_channel(out.width_px, out.height_px, typed<std::uint8_t>(chunk_bytes(frame, kAlpha))));
  const int classes = info_.classes.valid_count();
  for (const std::int16_t c : out.label)
    if (c < kVoid || c >= classes)
      throw Error(ErrorKind::data, "scene.packed.damaged",
                  fmt::format("'{}': frame '{}': label index {} is outside the class table", path_, info.name, c),
                  "pack the scene again");
}

}  // namespace semfield
