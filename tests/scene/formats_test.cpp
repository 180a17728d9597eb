// Files of a scene: images, arrays, writing and locking, names.
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <sys/wait.h>

#include <csignal>
#include <numeric>

#include "core/files.h"
#include "core/rng.h"
#include "core/text.h"
#include "core/workspace.h"
#include "formats/image_io.h"
#include "formats/text_rows.h"
#include "scene/loading/frame_files.h"
#include "scene/loading/frame_source.h"
#include "scene/loading/packed_scene.h"
#include "scene/scene.h"
#include "tests/scene/image_bytes.h"
#include "tests/scene/npz_files.h"
#include "tests/scene/tiny_scene.h"
#include "tests/threads.h"

namespace semfield {
namespace {

// Images and packed scenes: round trips, ids unchanged, damage named, area resize.

using namespace testing_room;

std::vector<std::uint8_t> noise(std::size_t count) {
  std::vector<std::uint8_t> out(count);
  std::uint32_t state = 12345;
  for (auto& v : out) v = static_cast<std::uint8_t>((state = state * 1664525u + 1013904223u) >> 24);
  return out;
}

void put_bytes(const std::string& path, const std::vector<std::uint8_t>& bytes) {
  testing_room::plain_write(path, {bytes.begin(), bytes.end()});
}

TEST(Png, RgbRoundTrip) {
  const std::string path = fresh_folder("i") + "/a.png";
  const auto rgb = noise(37 * 21 * 3);
  write_png_rgb(path, 37, 21, rgb);
  const Image<std::uint8_t> back = read_rgb(path);
  EXPECT_EQ((std::array{back.width_px, back.height_px, back.channels}), (std::array{37, 21, 3}));
  EXPECT_EQ(back.pixels, rgb);
  const ImageSize size = image_size(path);
  EXPECT_EQ((std::array{size.width_px, size.channels, size.bits}), (std::array{37, 3, 8}));
}

TEST(Png, PaletteEntriesMayBeTransparent) {
  const std::vector<std::uint8_t> index{0, 1, 2, 1, 0, 2}, rgb{0, 0, 0, 200, 30, 30, 5, 6, 7}, alpha{0};
  for (const int level : {1, 9}) {
    const std::vector<std::uint8_t> file = encode_png(3, 2, 3, 8, index, {rgb, alpha}, level);
    const PngImage back = decode_png(std::as_bytes(std::span(file)));
    EXPECT_TRUE(back.palette);
    EXPECT_EQ(back.bytes, index);
    EXPECT_EQ(back.palette_rgb, rgb);
    EXPECT_EQ(back.palette_alpha, alpha);
  }
}

TEST(Png, IdsAreUnchangedIn8And16BitAndPalette) {
  const std::string folder = fresh_folder("i");
  std::vector<std::uint8_t> ids(256);
  std::iota(ids.begin(), ids.end(), std::uint8_t{0});
  write_png_gray8(folder + "/g8.png", 16, 16, ids);
  std::vector<std::uint16_t> wide(256);
  for (std::size_t i = 0; i < 256; ++i) wide[i] = static_cast<std::uint16_t>(i * 257);
  write_png_gray16(folder + "/g16.png", 16, 16, wide);
  std::vector<std::uint8_t> palette = noise(768);
  write_png_palette(folder + "/p.png", 16, 16, ids, palette);
  const std::vector<std::uint16_t> expected(ids.begin(), ids.end());
  EXPECT_EQ(read_ids(folder + "/g8.png").pixels, expected);
  EXPECT_EQ(read_ids(folder + "/g16.png").pixels, wide);
  EXPECT_EQ(read_ids(folder + "/p.png").pixels, expected);
  EXPECT_EQ(image_size(folder + "/p.png").channels, 1);
  // As colour the palette counts.
  EXPECT_EQ(read_rgb(folder + "/p.png").pixels, palette);
}

// Case G02 of tests/numerics has interlaced images, and values of 1 to 16 bits.
TEST(Png, AllFiltersDecode) {
  // 3 x 5 grey rows, one a filter, against values worked out by hand.
  const std::vector<std::uint8_t> raw{0, 10, 20, 30, 1, 1, 2, 3, 2, 5, 5, 5, 3, 1, 1, 1, 4, 1, 1, 1};
  const std::string folder = fresh_folder("i");
  put_bytes(folder + "/f.png", png_of(3, 5, 8, 0, 0, raw));
  EXPECT_EQ(read_ids(folder + "/f.png").pixels,
            (std::vector<std::uint16_t>{10, 20, 30, 1, 3, 6, 6, 8, 11, 4, 7, 10, 5, 8, 11}));
}

TEST(Png, AlphaOverBackgroundOrDropped) {
  const std::string path = fresh_folder("i") + "/a.png";
  put_bytes(path, png_of(2, 1, 8, 6, 0, {0, 100, 50, 0, 255, 200, 100, 0, 51}));
  EXPECT_EQ(read_rgb(path, -1).pixels, (std::vector<std::uint8_t>{100, 50, 0, 200, 100, 0}));
  EXPECT_EQ(read_rgb(path, 255).pixels, (std::vector<std::uint8_t>{100, 50, 0, 244, 224, 204}));
}

TEST(Images, TruncatedJpegIsAnErrorNamingTheFile) {
  const std::string source = std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/studio_room/images/0001.jpg";
  if (!images_available() || !fs::exists(source))
    GTEST_SKIP() << "needs OpenImageIO and a JPEG of the optional studio room";
  const std::string path = fresh_folder("i") + "/a.jpg";
  write_file_atomic(path, read_text_file(source));  // not its mode: the original may be read-only
  EXPECT_EQ(read_rgb(path).width_px, 960);
  testing_room::cut(path, 5000);
  EXPECT_HAS(error_of([&] { (void)read_rgb(path); }), "'" + path + "': JPEG is truncated: it ends after ");
}

TEST(Images, AreaResizeAveragesExactly) {
  Image<std::uint8_t> in{4, 2, 1, {0, 10, 20, 30, 40, 50, 60, 70}};
  EXPECT_EQ(resize_area(in, 2, 1).pixels, (std::vector<std::uint8_t>{25, 45}));
  // 3 -> 2: each target pixel covers one source pixel and half of the middle one.
  Image<std::uint8_t> odd{3, 1, 1, {30, 60, 120}};
  EXPECT_EQ(resize_area(odd, 2, 1).pixels, (std::vector<std::uint8_t>{40, 100}));
  EXPECT_EQ(resize_area(odd, 3, 1).pixels, odd.pixels);
}

TEST(Images, NpyHeaderIsAligned) {
  const std::string path = fresh_folder("i") + "/a.npy";
  const std::vector<float> values{1, 2, 3, 4, 5, 6};
  const std::vector<std::int64_t> shape{2, 3};
  write_npy(path, shape, values);
  const std::string file = read_text_file(path);
  const std::size_t header = static_cast<unsigned char>(file[8]) + 256u * static_cast<unsigned char>(file[9]);
  EXPECT_EQ((10 + header) % 64, 0u);
  EXPECT_EQ(file.size(), 10 + header + 24);
  EXPECT_EQ(file.substr(10, 60), "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), } ");
  EXPECT_EQ(file[9 + header], '\n');
  float last = 0;
  std::memcpy(&last, file.data() + file.size() - 4, 4);
  EXPECT_EQ(last, 6.0f);
}

// Packed scenes: round trip, damage of any byte, lies about sizes.

SceneInfo room_info(int frames) {
  SceneInfo info{.name = "room", .metric = true, .near_hint_m = 0.1, .far_hint_m = 7};
  info.bounds.include({-2, -1.5, -2.5});
  info.bounds.include({2, 1.5, 2.5});
  std::vector<ClassEntry> classes{{0, "void", {}, true}, {1, "west", {1, 2, 3}, false}};
  for (const auto& [id, name] : {std::pair{2, "east"}, {3, "up"}, {40, "down"}, {50, "south"}, {600, "north"}})
    classes.push_back({id, name, {}, false});
  info.classes = ClassTable(classes);
  for (int i = 0; i < frames; ++i) {
    const std::string name = "rgb_" + std::to_string(i);
    const Split split = i % 2 == 0 ? Split::train : Split::test;
    info.frames.push_back({name, "somewhere/" + name, room_camera(12, 9), room_pose(i), split});
    info.frames.back().camera.k1 = 0.01 * i;
  }
  return info;
}

void render(const SceneInfo& info, int i, FrameBuffer& out) {
  out = render_room(info.frames[i].camera, info.frames[i].world_from_camera);
  if (i == 1) out.depth_m.clear();
  if (i == 2) out.label.clear();
  if (i == 0) out.label[5] = kVoid;
}

std::string packed_room(const std::string& folder, bool depth_as_mm, int frames = 3) {
  const std::string path = folder + "/room.semfield";
  const SceneInfo info = room_info(frames);
  write_packed_scene(
      path, info, [&](int i, FrameBuffer& out) { render(info, i, out); }, depth_as_mm);
  return path;
}

TEST(PackedScene, RoundTripIsExact) {
  const PackedScene scene(packed_room(fresh_folder("p"), false));
  const SceneInfo want = room_info(3);
  ASSERT_EQ(scene.info().frames.size(), 3u);
  EXPECT_EQ(scene.info().name, "room");
  EXPECT_EQ(scene.info().far_hint_m, 7.0);
  EXPECT_EQ(scene.info().bounds.hi, want.bounds.hi);
  EXPECT_EQ(scene.info().classes.to_yaml(), want.classes.to_yaml());
  for (int i = 0; i < 3; ++i) {
    const auto n = static_cast<std::size_t>(i);
    const FrameInfo& f = scene.info().frames[n];
    EXPECT_EQ(f.name, want.frames[n].name);
    EXPECT_EQ(f.camera.k1, want.frames[n].camera.k1);
    EXPECT_EQ(f.world_from_camera.r, want.frames[n].world_from_camera.r);
    EXPECT_EQ(f.split, want.frames[n].split);
    EXPECT_EQ(f.has_depth, i != 1);
    EXPECT_EQ(f.has_labels, i != 2);
    FrameBuffer a, b;
    render(want, i, a);
    scene.read(i, b);
    EXPECT_EQ(a.rgb, b.rgb);
    EXPECT_EQ(a.depth_m, b.depth_m);
    EXPECT_EQ(a.label, b.label);
    EXPECT_EQ(a.instance, b.instance);
  }
}

// A sweep packs a scene as its files are; what its cells say of the poses in the files holds for the packed scene too.
TEST(PackedScene, RemembersTheAxesOfTheFilesAndWhosePosesTheyAre) {
  for (const bool metric : {false, true}) {
    for (const bool opengl : {false, true}) {
      SceneInfo info = room_info(1);
      info.metric = metric;
      info.opengl_files = opengl;
      info.tracked = metric != opengl;
      const std::string path = fresh_folder("p") + "/room.semfield";
      write_packed_scene(path, info, [&](int i, FrameBuffer& out) { render(info, i, out); });
      const PackedScene scene(path);
      EXPECT_EQ(scene.info().metric, metric);
      EXPECT_EQ(scene.info().opengl_files, opengl);
      EXPECT_EQ(scene.info().tracked, metric != opengl);
    }
  }
}

TEST(PackedScene, MillimetresRoundToHalfAMillimetre) {
  const PackedScene scene(packed_room(fresh_folder("p"), true));
  FrameBuffer a, b;
  render(room_info(3), 0, a);
  scene.read(0, b);
  ASSERT_EQ(a.depth_m.size(), b.depth_m.size());
  for (std::size_t i = 0; i < a.depth_m.size(); ++i) EXPECT_NEAR(a.depth_m[i], b.depth_m[i], 0.000501);
}

TEST(PackedScene, DepthInAnotherUnitIsNotRounded) {
  for (const float scale : {1e-4F, 1e3F, 1e6F}) {
    const auto scaled = [&](int i, FrameBuffer& out) {
      render(room_info(3), i, out);
      for (float& depth : out.depth_m) depth *= scale;
    };
    const std::string path = fresh_folder("p") + "/room.semfield";
    write_packed_scene(path, room_info(3), scaled);
    FrameBuffer a, b;
    scaled(0, a);
    PackedScene(path).read(0, b);
    EXPECT_EQ(a.depth_m, b.depth_m) << scale;
  }
}

TEST(PackedScene, FailingSourceLeavesNoFile) {
  const std::string folder = fresh_folder("p");
  const SceneInfo info = room_info(2);
  const auto broken = [](int, FrameBuffer&) { throw Error(ErrorKind::data, "test.error.made", "broken frame"); };
  EXPECT_THROW(write_packed_scene(folder + "/a", info, broken), Error);
  EXPECT_TRUE(fs::is_empty(folder));
}

// NumPy arrays: types, orders, archives, and files that lie.

std::string npy(const std::string& header, const std::string& data, int version = 1) {
  std::string out = "\x93NUMPY";
  out += static_cast<char>(version);
  out += '\0';
  out += static_cast<char>(header.size() & 0xFF);
  out += static_cast<char>(header.size() >> 8);
  if (version > 1) out += std::string(2, '\0');
  return out + header + data;
}
std::string header(const std::string& type, const std::string& shape, const std::string& fortran = "False") {
  return "{'descr': '" + type + "', 'fortran_order': " + fortran + ", 'shape': " + shape + ", }\n";
}
template <class T>
std::string npz_bytes_of(const std::vector<T>& values) {
  return {reinterpret_cast<const char*>(values.data()), values.size() * sizeof(T)};
}

struct NpyCase {
  std::string path = fresh_folder("t") + "/a.npy";
  NumpyArray read(const std::string& bytes) const {
    plain_write(path, bytes);
    return read_npy(path, {});
  }
  std::string error(const std::string& bytes) const {
    return error_of([&] { (void)read(bytes); });
  }
};

TEST(Npy, TypesOrdersAndVersions) {
  const NpyCase c;
  using Floats = std::vector<float>;
  const Floats want{0, 0.5F, 1, 1.5F, 2, 2.5F};
  const std::string bytes = npz_bytes_of(want), wide = npz_bytes_of(std::vector<double>(want.begin(), want.end()));
  EXPECT_EQ(c.read(npy(header("<f4", "(2, 3)"), bytes)).values, want);
  EXPECT_EQ(c.read(npy(header("<f4", "(2, 3)"), bytes, 2)).shape, (std::vector<std::int64_t>{2, 3}));
  EXPECT_EQ(c.read(npy(header("<f8", "(6,)"), wide)).values, want);
  EXPECT_EQ(c.read(npy(header("<f2", "(2,)"), std::string("\x00\x3C\x00\x38", 4))).values, (Floats{1, 0.5F}));
  EXPECT_EQ(c.read(npy(header(">f2", "(2,)"), std::string("\x3C\x00\x38\x00", 4))).values, (Floats{1, 0.5F}));
  const NumpyArray u = c.read(npy(header("|u1", "(3,)"), std::string("\xFF\x00\x33", 3)));
  EXPECT_TRUE(u.from_bytes);
  EXPECT_EQ(u.values, (Floats{1, 0, 0.2F}));
  EXPECT_EQ(c.read(npy(header("<f4", "(3, 2)", "True"), bytes)).values, (Floats{0, 1.5F, 0.5F, 2, 1, 2.5F}));
  EXPECT_EQ(c.read(npy(header("<f4", "()"), npz_bytes_of(Floats{7}))).values, Floats{7});
  EXPECT_TRUE(c.read(npy(header("<f4", "(0, 3)"), "")).values.empty());
}

TEST(Npz, WrittenArraysAreReadBack) {
  const std::string path = fresh_folder("t") + "/a.npz";
  std::vector<float> values;
  for (int i = 0; i < 1000; ++i) values.push_back(static_cast<float>(i) / 1024.0F);
  const std::vector<NpzEntry> entries{{"probability", {10, 20, 5}, values}, {"one", {1}, std::span(values).first(1)}};
  write_npz(path, entries);
  EXPECT_EQ(NpzFile(path).keys(), (std::vector<std::string>{"probability", "one"}));
  const NumpyArray back = NpzFile(path).read("probability", {});
  EXPECT_EQ(back.shape, (std::vector<std::int64_t>{10, 20, 5}));
  EXPECT_EQ(back.values, values);
  EXPECT_HAS(error_of([&] { (void)NpzFile(path).read("two", {}); }), path, "two");
}

TEST(Npz, BytesAndIntegersAreReadAsTheyAreStored) {
  const std::string path = fresh_folder("t") + "/a.npz";
  ZipWriter archive(path);
  archive.add("mask.npy", npy(header("|b1", "(2, 2)", "True"), std::string("\1\0\0\2", 4)));
  archive.add("short.npy", npy(header(">i2", "(2,)"), std::string("\xFF\xFE\x01\x02", 4)));
  archive.add("long.npy", npy(header("<i8", "(1,)"), npz_bytes_of(std::vector<std::int64_t>{-5})));
  archive.add("wide.npy", npy(header("<u8", "(1,)"), std::string(8, '\1')));
  archive.write();
  const NpzFile file(path);
  EXPECT_EQ(file.keys(), (std::vector<std::string>{"mask", "short", "long", "wide"}));
  EXPECT_EQ(file.bytes("mask", {}).values, (std::vector<std::uint8_t>{1, 0, 0, 2}));
  EXPECT_EQ(file.whole("short", {}).values, (std::vector<std::int64_t>{-2, 258}));
  EXPECT_EQ(file.whole("long", {}).values, (std::vector<std::int64_t>{-5}));
  EXPECT_HAS(error_of([&] { (void)file.whole("wide", {}); }), path, "wide", "<u8");
  EXPECT_HAS(error_of([&] { (void)file.bytes("short", {}); }), path, "short", ">i2");
}

// Numbers, lowest byte first, each in so many bytes.
std::string numbers(const std::vector<std::pair<std::uint64_t, int>>& values) {
  std::string out;
  for (const auto& [value, bytes] : values) {
    for (int i = 0; i < bytes; ++i) out += static_cast<char>((value >> (8 * i)) & 0xFF);
  }
  return out;
}

// An archive of one stored entry, with ZIP64 sizes in both headers.
std::string stored64(const std::string& data, std::uint64_t bytes, std::uint64_t packed, unsigned method = 0,
                     unsigned flags = 0) {
  const auto crc = crc32(0, reinterpret_cast<const Bytef*>(data.data()), static_cast<uInt>(data.size()));
  const std::string common = numbers({{45, 2}, {flags, 2}, {method, 2}, {0, 4}, {crc, 4}}) +
                             numbers({{0xFFFFFFFF, 4}, {0xFFFFFFFF, 4}, {5, 2}, {20, 2}});
  const std::string extra = numbers({{1, 2}, {16, 2}, {bytes, 8}, {packed, 8}});
  const std::string entry = numbers({{0x04034b50, 4}}) + common + "a.npy" + extra + data;
  const std::string directory =
      numbers({{0x02014b50, 4}, {45, 2}}) + common + numbers({{0, 8}, {0, 2}, {0, 4}}) + "a.npy" + extra;
  return entry + directory +
         numbers({{0x06054b50, 4}, {0, 4}, {1, 2}, {1, 2}, {directory.size(), 4}, {entry.size(), 4}, {0, 2}});
}

TEST(Npz, Zip64SizesAndArchivesThatLie) {
  const std::string path = fresh_folder("t") + "/a.npz";
  const std::string data = npy(header("<f4", "(2,)"), npz_bytes_of(std::vector<float>{3, 4}));
  plain_write(path, stored64(data, data.size(), data.size()));
  EXPECT_EQ(NpzFile(path).read("a", {}).values, (std::vector<float>{3, 4}));
  const auto error = [&](const std::string& bytes) {
    plain_write(path, bytes);
    return error_of([&] { (void)NpzFile(path).read("a", {}); });
  };
  const std::string file = "'" + path + "', entry 'a': ", again = "; save the file again, or copy it again in full";
  EXPECT_EQ(error(stored64(data, 99, data.size())), file + "its two sizes differ though it is not packed" + again);
  EXPECT_EQ(error(stored64(data, 1ull << 60, 1ull << 60)), file + "it runs past the end of the file" + again);
  EXPECT_EQ(error(stored64(data, 1ull << 60, data.size(), 8)),
            file + "it claims to hold 1152921504606846976 bytes, more than its " + std::to_string(data.size()) +
                " packed ones can be" + again);
  EXPECT_EQ(error(stored64(data, 500, data.size(), 8)), file + "its packed data are damaged or cut off" + again);
  EXPECT_EQ(error(stored64(data, data.size(), data.size(), 12)),
            file + "compression method 12 is not read; save it with numpy.savez or numpy.savez_compressed");
  EXPECT_EQ(error(stored64(data, data.size(), data.size(), 0, 1)), "'" + path + "': entry 'a.npy' is encrypted");
  std::string bad = stored64(data, data.size(), data.size());
  bad[30 + 5 + 20 + data.size() - 1] ^= 1;
  EXPECT_EQ(error(bad), file + "its checksum is wrong" + again);
  EXPECT_EQ(error(""), "'" + path + "': not a zip archive: its end is missing" + again);
}

// The last bytes are damaged: whoever unpacks them before the shape is compared reports the damage instead.
TEST(Npz, AShapeThatIsNotWantedIsRefusedBeforeAnythingIsUnpacked) {
  const std::string path = fresh_folder("t") + "/a.npz";
  std::vector<float> values(400'000);
  for (std::size_t i = 0; i < values.size(); ++i)  // what does not pack
    values[i] = static_cast<float>(uniform_below({1, 0, stream_id("npz")}, i, 2048));
  const NpzEntry entry{"a", {400, 1000}, values};
  write_npz(path, std::span(&entry, 1));
  std::string file = read_text_file(path);
  for (std::size_t at = file.size() - 4200; at < file.size() - 4100; ++at) file[at] = static_cast<char>(~file[at]);
  plain_write(path, file);
  const auto read = [&](std::int64_t width) {
    return error_of([&] {
      (void)NpzFile(path).read("a", [&](std::span<const std::int64_t> shape) {
        if (shape[1] != width) throw Error(ErrorKind::data, "test.error.made", "another shape: " + shape_text(shape));
      });
    });
  };
  EXPECT_EQ(read(999), "'" + path + "', entry 'a': another shape: (400, 1000)");
  EXPECT_HAS(read(1000), path);
  EXPECT_LACKS(read(1000), "another shape");
}

TEST(Npy, IntegersAndRealNumbersAsTheyAreStored) {
  const NpyCase c;
  const auto read = [&](const std::string& bytes) {
    plain_write(c.path, bytes);
    return read_npy_values(c.path, {});
  };
  const NumpyValues steps = read(npy(header("<u2", "(2, 2)"), npz_bytes_of<std::uint16_t>({1, 65535, 3, 4})));
  EXPECT_EQ(steps.values, (std::vector<double>{1, 65535, 3, 4}));
  EXPECT_TRUE(steps.is_whole);
  EXPECT_EQ(steps.element_bytes, 2u);
  EXPECT_TRUE(npy_is_whole(c.path));
  EXPECT_EQ(npy_shape(c.path), (std::vector<std::int64_t>{2, 2}));
  EXPECT_EQ(read(npy(header("|u1", "(2,)"), "\x01\xFF")).values, (std::vector<double>{1, 255}));
  EXPECT_EQ(read(npy(header(">i2", "(2,)"), std::string("\x00\x02\xFF\xFE", 4))).values, (std::vector<double>{2, -2}));
  const NumpyValues real = read(npy(header("<f8", "(1,)"), npz_bytes_of<double>({0.1})));
  EXPECT_EQ(real.values, (std::vector<double>{0.1}));
  EXPECT_FALSE(real.is_whole);
  EXPECT_FALSE(npy_is_whole(c.path));
  EXPECT_ERROR(read(npy(header("<u8", "(1,)"), std::string(8, '\1'))), "files.array.type", "<u8");
}

// Fortran order: the first axis is the fastest. Long axes go in blocks.
TEST(Npy, FortranOrderOfAnyShape) {
  const NpyCase c;
  for (const std::vector<std::int64_t>& shape : std::vector<std::vector<std::int64_t>>{
           {5}, {70, 130}, {2, 3, 4}, {70, 2, 130}, {3, 2, 1, 2, 65}, {1, 66, 2}, {0, 3}}) {
    std::vector<std::int32_t> stored;
    std::int64_t count = 1;
    for (const std::int64_t axis : shape) count *= axis;
    for (std::int32_t i = 0; i < count; ++i) stored.push_back(i);
    plain_write(c.path, npy(header("<i4", shape_text(shape), "True"), npz_bytes_of(stored)));
    const NumpyValues found = read_npy_values(c.path, {});
    for (std::int64_t place = 0; place < count; ++place) {
      std::int64_t rest = place, from = 0;  // from the index in C order to the place in Fortran order
      for (std::size_t a = shape.size(); a-- > 0; rest /= shape[a]) from = from * shape[a] + rest % shape[a];
      ASSERT_EQ(found.values.at(static_cast<std::size_t>(place)), from) << shape_text(shape) << " at " << place;
    }
  }
}

// Each entry would unpack the same bytes again.
TEST(Npz, EntriesThatOverlapAreRefused) {
  const std::string path = fresh_folder("o") + "/a.npz";
  const std::vector<float> values(100, 1);
  const NpzEntry entries[] = {{"a", {100}, values}, {"b", {100}, values}};
  write_npz(path, entries);
  EXPECT_EQ(NpzFile(path).keys().size(), 2u);
  std::string file = read_text_file(path);
  const std::size_t second = file.rfind("PK\x01\x02");
  for (std::size_t i = 0; i < 4; ++i) file[second + 42 + i] = '\0';  // where its data begin
  plain_write(path, file);
  EXPECT_ERROR(NpzFile(path), "files.zip.damaged", "'a.npy' and 'b.npy' overlap");
}

TEST(Npy, AShapeThatIsNotWantedOrTooLargeIsRefusedByItsHeader) {
  const NpyCase c;
  plain_write(c.path, npy(header("|u1", "(2, 3)"), std::string(6, '\1')));
  const auto none = [](std::span<const std::int64_t> shape) {
    throw Error(ErrorKind::data, "test.error.made", "not " + shape_text(shape));
  };
  EXPECT_EQ(error_of([&] { (void)read_npy(c.path, none); }), "'" + c.path + "': not (2, 3)");
  const InputLimits small{.image_bytes = 23};  // six values of four bytes are 24
  WorkSettings work{.limits = &small};
  const WorkScope scope(work);
  EXPECT_HAS(error_of([&] { (void)read_npy(c.path, {}); }), "'" + c.path + "'", "(2, 3)", "24 bytes", "at most 23",
             "limits.image_bytes");
}

// Whole files, atomically; frames as they are kept in memory; which frames are held out.

std::size_t entries(const std::string& folder) {
  std::size_t count = 0;
  for ([[maybe_unused]] const auto& e : fs::directory_iterator(folder)) ++count;
  return count;
}

struct Files : testing::Test {
  const std::string folder = fresh_folder("f");
};

TEST_F(Files, WritesReplacesAndLeavesNothingBehind) {
  const std::string path = folder + "/a.txt";
  write_file_atomic(path, std::string_view("one"));
  write_file_atomic(path, std::string_view("two, longer"));
  EXPECT_EQ(read_text_file(path), "two, longer");
  EXPECT_EQ(read_file_start(path, 3), "two");
  EXPECT_EQ(entries(folder), 1u);
}

TEST_F(Files, AbandonedFileKeepsTheOldOne) {
  const std::string path = folder + "/a.bin";
  write_file_atomic(path, std::string_view("old"));
  {
    AtomicFile file(path);
    const std::vector<std::byte> bytes(100000);
    file.append(bytes);
    EXPECT_EQ(file.size(), 100000u);
    EXPECT_EQ(read_text_file(path), "old");
    EXPECT_EQ(entries(folder), 2u);
  }
  EXPECT_EQ(read_text_file(path), "old");
  EXPECT_EQ(entries(folder), 1u);
}

TEST_F(Files, OverwriteChangesBytesInPlace) {
  const std::string path = folder + "/a.bin";
  AtomicFile file(path);
  file.append(std::as_bytes(std::span<const char>("hello", 5)));
  file.overwrite(1, std::as_bytes(std::span<const char>("a", 1)));
  file.commit();
  EXPECT_EQ(read_text_file(path), "hallo");
}

TEST_F(Files, ErrorsNamePathCauseAndRemedy) {
  EXPECT_HAS(error_of([&] { (void)read_text_file(folder + "/none"); }), folder + "/none", "or directory");
  EXPECT_HAS(error_of([&] { (void)read_text_file(folder); }), folder, "a file");
  EXPECT_HAS(error_of([&] { write_file_atomic(folder + "/no/a.txt", std::string_view("x")); }), folder + "/no/a.txt",
             "or directory");
  write_file_atomic(folder + "/big", std::string(101, 'x'));
  EXPECT_HAS(error_of([&] { (void)read_text_file(folder + "/big", 100); }), folder + "/big", "100");
  fs::create_directories(folder + "/taken/inside");
  EXPECT_HAS(error_of([&] { write_file_atomic(folder + "/taken", std::string_view("x")); }), folder + "/taken",
             "a directory");
  EXPECT_EQ(entries(folder), 2u);
}

// A pipe without a writer, and a device that never ends, would otherwise be waited for.
TEST_F(Files, OnlyRegularFilesAreRead) {
  const std::string pipe = folder + "/pipe.png";
  ASSERT_EQ(::mkfifo(pipe.c_str(), 0600), 0);
  const auto why = [](const std::string& path) { return error_of([&] { (void)read_file_start(path, 1); }); };
  EXPECT_EQ(why(pipe), "'" + pipe + "' is a pipe, not a file; check the path");
  EXPECT_EQ(error_of([&] { (void)read_text_file(pipe); }), why(pipe));
  EXPECT_EQ(error_of([&] { (void)image_size(pipe); }), why(pipe));
  EXPECT_EQ(error_of([&] { (void)read_float(pipe); }), why(pipe));
  EXPECT_EQ(error_of([&] { PackedScene scene(pipe); }), why(pipe));
  EXPECT_EQ(why("/dev/zero"), "'/dev/zero' is a device, not a file; check the path");

  const int server = ::socket(AF_UNIX, SOCK_STREAM, 0);
  sockaddr_un address{AF_UNIX, "semfield_test_socket"};
  const fs::path back = fs::current_path();
  fs::current_path(folder);  // a socket's path has room for 107 bytes
  EXPECT_EQ(::bind(server, reinterpret_cast<const sockaddr*>(&address), sizeof address), 0);
  EXPECT_EQ(why(address.sun_path), "'semfield_test_socket' is a socket, not a file; check the path");
  fs::current_path(back);
  ::close(server);
}

// A process that is killed between append and commit leaves its file; one that lives keeps it.
TEST_F(Files, TemporariesOfTheDeadGoAndThoseOfTheLivingStay) {
  AtomicFile living(folder + "/b.bin");
  const pid_t child = ::fork();
  if (child == 0) {
    AtomicFile file(folder + "/a.bin");
    file.append(std::vector<std::byte>(10));
    ::raise(SIGKILL);
  }
  ASSERT_EQ(::waitpid(child, nullptr, 0), child);
  EXPECT_EQ(entries(folder), 2u) << "the child left nothing: the test tries nothing";
  plain_write(folder + "/.notes.tmp", "no number, so not ours");
  EXPECT_EQ(remove_stale_temporaries(folder), 1);
  EXPECT_EQ(remove_stale_temporaries(folder), 0);
  living.commit();
  EXPECT_TRUE(fs::exists(folder + "/b.bin"));
  EXPECT_TRUE(fs::exists(folder + "/.notes.tmp"));
  EXPECT_EQ(entries(folder), 2u);
  EXPECT_EQ(remove_stale_temporaries(folder + "/none"), 0);
}

TEST_F(Files, TheNextWriteOfATargetRemovesWhatTheLastOneLeft) {
  plain_write(folder + "/.a.bin.0.tmp", "left by a killed writer");
  write_file_atomic(folder + "/a.bin", std::string_view("new"));
  EXPECT_EQ(entries(folder), 1u);
  // Two writers of one target at a time: each has its own file, the last to commit wins.
  AtomicFile first(folder + "/a.bin"), second(folder + "/a.bin");
  EXPECT_EQ(entries(folder), 3u);
  second.append(std::as_bytes(std::span<const char>("second", 6)));
  second.commit();
  first.append(std::as_bytes(std::span<const char>("first", 5)));
  first.commit();
  EXPECT_EQ(read_text_file(folder + "/a.bin"), "first");
  EXPECT_EQ(entries(folder), 1u);
}

// Names of that form are not this program's alone, and what lies in the folder of a user is not known.
TEST_F(Files, AWriteRemovesNothingOfOtherTargets) {
  for (const char* name : {"/.mesh.ply.0.tmp", "/.syncthing.frame.0001.tmp"}) plain_write(folder + name, "not ours");
  write_file_atomic(folder + "/mesh.glb", std::string_view("new"));
  EXPECT_EQ(entries(folder), 3u);
  EXPECT_EQ(remove_stale_temporaries(folder), 2) << "as in a folder of its own";
}

// What a handler of signals does: own files go, those of another writer and of a process that was forked do not.
TEST_F(Files, AProcessThatEndsBySignalRemovesItsOwn) {
  AtomicFile other(folder + "/other");
  const pid_t child = ::fork();
  if (child == 0) {
    AtomicFile first(folder + "/first"), done(folder + "/done");
    done.commit();
    remove_own_temporaries();
    ::raise(SIGKILL);
  }
  ASSERT_EQ(::waitpid(child, nullptr, 0), child);
  EXPECT_EQ(entries(folder), 2u);
  EXPECT_TRUE(fs::exists(folder + "/done"));
  other.commit();
  EXPECT_TRUE(fs::exists(folder + "/other"));
}

TEST_F(Files, WhatDoesNotVerifyTakesNoName) {
  write_file_atomic(folder + "/a", std::string_view("old"));
  {
    AtomicFile file(folder + "/a");
    file.append(std::as_bytes(std::span<const char>("bad", 3)));
    const auto verify = [](const std::string& written) {
      EXPECT_EQ(read_text_file(written), "bad");
      throw Error(ErrorKind::io, "test.error.made", "it is bad");
    };
    EXPECT_EQ(error_of([&] { file.commit(verify); }), "it is bad");
  }
  EXPECT_EQ(read_text_file(folder + "/a"), "old");
  EXPECT_EQ(entries(folder), 1u);
}

TEST_F(Files, FoldersAreMadeWithThoseAbove) {
  create_folders(folder + "/a/b/c/");
  create_folders(folder + "/a/b");
  EXPECT_TRUE(fs::is_directory(folder + "/a/b/c"));
  write_file_atomic(folder + "/file", std::string_view("x"));
  EXPECT_HAS(error_of([&] { create_folders(folder + "/file/under"); }), folder + "/file/under", "a directory");
}

// What a loaded scene keeps of its frames: every value exactly, in the narrowest type.

constexpr std::size_t kPixels = 40 * 30;

TEST(LabelMap, OneByteUpToIndex254) {
  std::vector<std::int16_t> labels{kVoid, 0, 1, 253, 254};
  const LabelMap narrow(labels);
  EXPECT_EQ(narrow.expand(), labels);
  EXPECT_EQ(narrow.bytes(), labels.size());
  for (std::size_t i = 0; i < labels.size(); ++i) EXPECT_EQ(narrow[i], labels[i]);
  labels.push_back(255);
  const LabelMap wide(labels);
  EXPECT_EQ(wide.expand(), labels);
  for (std::size_t i = 0; i < labels.size(); ++i) EXPECT_EQ(wide[i], labels[i]);
  EXPECT_TRUE(LabelMap().empty());
}

TEST(DepthMap, WholeMillimetresTakeTwoBytesAndOthersStayAsTheyAre) {
  std::vector<float> depth;
  for (int mm = 0; mm <= 65535; ++mm) depth.push_back(static_cast<float>(mm * 0.001));
  const DepthMap packed(depth);
  EXPECT_EQ(packed.expand(), depth);
  EXPECT_EQ(packed.bytes(), 2 * depth.size());
  for (const float odd : {1.00049f, 65.536f, -0.001f, std::numeric_limits<float>::quiet_NaN(),
                          std::numeric_limits<float>::infinity(), 1e30f}) {
    std::vector<float> with = depth;
    with[7000] = odd;
    const DepthMap kept(with);
    const std::vector<float> back = kept.expand();
    ASSERT_EQ(back.size(), with.size());
    EXPECT_EQ(std::memcmp(back.data(), with.data(), with.size() * sizeof(float)), 0) << odd;
    EXPECT_GE(kept.bytes(), 4 * depth.size());
  }
}

// Frames of a Replica folder, read as the datasets read them.
struct FileDataset {
  explicit FileDataset(std::string written_here) : folder(std::move(written_here)) {
    write_replica(folder, 6);
    classes = ClassTable::load(folder + "/classes.yaml");
  }
  std::string folder;
  ClassTable classes;

  SceneInfo open(Diagnostics&) const {
    SceneInfo info{.name = "files", .classes = classes};
    for (int i = 0; i < 6; ++i) {
      info.frames.push_back({.name = std::to_string(i), .camera = room_camera(), .world_from_camera = room_pose(i)});
      FrameInfo& f = info.frames.back();
      f.split = i % 2 == 0 ? Split::train : Split::test;
      f.has_depth = f.has_labels = f.has_instances = true;
    }
    return info;
  }
  void read(int i, FrameBuffer& out) const {
    const std::string n = "_" + std::to_string(i) + ".png";
    const FrameFiles files{folder + "/rgb/rgb" + n, folder + "/depth/depth" + n,
                           folder + "/semantic_class/semantic_class" + n,
                           folder + "/semantic_instance/semantic_instance" + n};
    Diagnostics ignored;
    read_frame_files(open(ignored).frames[i], files, {}, classes, out);
  }
};

LoadedScene load_on(const FileDataset& files, int threads, DepthKept depth) {
  SceneLoadOptions options{.depth = depth};
  Diagnostics d;
  const ThreadScope scope(threads);
  LoadedScene scene = load_scene(files, options, d);
  EXPECT_TRUE(d.all().empty());
  return scene;
}

TEST(StoredFrame, ParallelDecodingGivesTheBytesOfTheFiles) {
  const FileDataset files(fresh_folder("files"));
  const LoadedScene serial = load_on(files, 1, DepthKept::all), parallel = load_on(files, 3, DepthKept::all);
  for (std::size_t i = 0; i < 6; ++i) {
    FrameBuffer read;
    files.read(static_cast<int>(i), read);
    for (const LoadedScene* scene : {&serial, &parallel}) {
      EXPECT_EQ(scene->frames[i].rgb, read.rgb);
      EXPECT_EQ(scene->frames[i].label.expand(), read.label);
      EXPECT_EQ(scene->frames[i].depth_m.expand(), read.depth_m);
    }
  }
  EXPECT_EQ(serial.class_pixels, parallel.class_pixels);
}

TEST(StoredFrame, KeepsThreeBytesOfColourOneOfLabelAndTwoOfDepthAPixel) {
  const FileDataset files(fresh_folder("files"));
  const std::size_t rows = 30;  // a decoded PNG may keep the room of its filter bytes, one per row
  for (const StoredFrame& frame : load_on(files, 2, DepthKept::all).frames) {
    EXPECT_GE(frame.bytes(), kPixels * (3 + 1 + 2));
    EXPECT_LE(frame.bytes(), kPixels * (3 + 1 + 2) + rows);
  }
  const LoadedScene tests = load_on(files, 2, DepthKept::test);
  for (std::size_t i = 0; i < 6; ++i) {
    EXPECT_LE(tests.frames[i].bytes(), kPixels * (i % 2 == 0 ? 4 : 6) + rows);
    EXPECT_EQ(tests.frames[i].depth_m.empty(), i % 2 == 0);
  }
  EXPECT_EQ(tests.bounds_from, "depth of 3 training frames") << "dropped after it was surveyed";
}

// Which frames are held out.

std::string splits(HoldOut rule, std::size_t frames) {
  std::string out;
  for (std::size_t i = 0; i < frames; ++i) out += rule.split_of(i, frames) == Split::test ? 'T' : '.';
  return out;
}

TEST(HoldOut, EveryNthFromTheFirst) {
  EXPECT_EQ(splits({8}, 10), "T.......T.");
  EXPECT_EQ(splits({2, 1}, 5), ".T.T.");
  EXPECT_EQ(splits({0}, 3), "...");
  EXPECT_EQ(splits({0, -1}, 3), "...");
  EXPECT_EQ(splits({8}, 1), ".");
}

TEST(HoldOut, OneInOneIsRefused) {
  Diagnostics d;
  check_root_and_test_every("r", 1, d);
  ASSERT_EQ(d.error_count(), 1);
  EXPECT_EQ(d.all()[0].text(), "test_every: 1 leaves no frame to train on; take 2 or more, or 0 for no test frames");
  check_root_and_test_every("r", 0, d);
  check_root_and_test_every("r", 2, d);
  EXPECT_EQ(d.error_count(), 1);
}

// Files under names that another system wrote.

// Of each pair the first is the composed form, as Unicode's own table has it.
TEST(UnicodeForms, ComposedCharactersAreTakenApart) {
  for (const auto& [composed, apart] : {std::pair{"caf\u00E9", "cafe\u0301"},
                                        {"\u1EC7", "e\u0323\u0302"},  // two marks: e, dot below, circumflex
                                        {"\u0439\u0451", "\u0438\u0306\u0435\u0308"},        // Cyrillic
                                        {"\u304C\u30D7", "\u304B\u3099\u30D5\u309A"},        // kana
                                        {"\uAC00\uD55C", "\u1100\u1161\u1112\u1161\u11AB"},  // Hangul
                                        {"\u03AF", "\u03B9\u0301"}}) {
    EXPECT_EQ(decomposed(composed), apart);
    EXPECT_EQ(decomposed(apart), apart);
  }
  for (const std::string same : {"", "plain-1.png", "\xFF\xC3", "\xE6\x97\xA5\xF0\x9F\x93\xB7"})
    EXPECT_EQ(decomposed(same), same);
}

TEST(FileNames, OfOtherSystems) {
  const std::string folder = fresh_folder("f"), apart = "cafe\u0301", composed = "caf\u00E9";
  for (const char* sub : {"/a", "/both"}) fs::create_directories(folder + sub + "/" + apart);
  fs::create_directories(folder + "/both/" + composed);
  plain_write(folder + "/a/" + apart + "/1.png", "x");
  plain_write(folder + "/a\\2.png", "x");
  plain_write(folder + "/both/" + apart + "/1.png", "x");
  FileNames names;
  EXPECT_EQ(names.of(folder + "/a/" + apart + "/1.png"), folder + "/a/" + apart + "/1.png");
  EXPECT_EQ(names.of(folder + "/a/" + composed + "/1.png"), folder + "/a/" + apart + "/1.png");
  EXPECT_EQ(names.of(folder + "\\a\\" + composed + "\\1.png"), folder + "/a/" + apart + "/1.png");
  EXPECT_EQ(names.of(folder + "/a\\2.png"), folder + "/a\\2.png") << "a file of that name";
  EXPECT_EQ(names.of(folder + "/a\\3.png"), folder + "/a/3.png");
  EXPECT_EQ(names.of(folder + "/both/" + composed + "/1.png"), folder + "/both/" + composed + "/1.png")
      << "a folder of that very name is there";
}

}  // namespace
}  // namespace semfield
