// Images and packed scenes: round trips, ids unchanged, damage named, area resize.
#include "formats/image_io.h"

#include <cstring>
#include <numeric>

#include "compute/parallel.h"
#include "formats/png_codec.h"
#include "loading/packed_scene.h"
#include "system/files.h"
#include "tests/scene/png_bytes.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

std::vector<std::uint8_t> noise(std::size_t count) {
  std::vector<std::uint8_t> out(count);
  std::uint32_t state = 12345;
  for (auto& v : out) v = static_cast<std::uint8_t>((state = state * 1664525u + 1013904223u) >> 24);
  return out;
}

std::vector<std::uint8_t> bytes_of(const std::string& path) {
  const std::string text = read_text_file(path);
  return {text.begin(), text.end()};
}

void put_bytes(const std::string& path, const std::vector<std::uint8_t>& bytes) {
  testing_room::plain_write(path, {bytes.begin(), bytes.end()});
}

TEST(Png, RgbRoundTrip) {
  const std::string path = fresh_folder("i") + "/a.png";
  const auto rgb = noise(37 * 21 * 3);
  write_png_rgb(path, 37, 21, rgb);
  const Image<std::uint8_t> back = read_rgb(path);
  EXPECT_EQ(back.width_px, 37);
  EXPECT_EQ(back.height_px, 21);
  EXPECT_EQ(back.channels, 3);
  EXPECT_EQ(back.pixels, rgb);
  const ImageSize size = image_size(path);
  EXPECT_EQ(size.width_px, 37);
  EXPECT_EQ(size.channels, 3);
  EXPECT_EQ(size.bits, 8);
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

TEST(Png, AllFiltersAndInterlaceDecode) {
  // 3 x 5 grey rows, one a filter, against values worked out by hand.
  const std::vector<std::uint8_t> raw{0, 10, 20, 30, 1, 1, 2, 3, 2, 5, 5, 5, 3, 1, 1, 1, 4, 1, 1, 1};
  const std::string folder = fresh_folder("i");
  put_bytes(folder + "/f.png", png_of(3, 5, 8, 0, 0, raw));
  EXPECT_EQ(read_ids(folder + "/f.png").pixels,
            (std::vector<std::uint16_t>{10, 20, 30, 1, 3, 6, 6, 8, 11, 4, 7, 10, 5, 8, 11}));
  // Adam7 of a 4 x 4 image with value 4 y + x: passes 1 (0,0), 2 none, 3 none, 4 (2,0), 5 rows y=2, 6 odd columns of
  // even rows, 7 odd rows.
  const std::vector<std::uint8_t> adam{0, 0, 0, 2, 0, 8, 10, 0, 1, 3, 0, 9, 11, 0, 4, 5, 6, 7, 0, 12, 13, 14, 15};
  put_bytes(folder + "/a.png", png_of(4, 4, 8, 0, 1, adam));
  std::vector<std::uint16_t> counting(16);
  std::iota(counting.begin(), counting.end(), std::uint16_t{0});
  EXPECT_EQ(read_ids(folder + "/a.png").pixels, counting);
  // Two bits per sample.
  put_bytes(folder + "/b.png", png_of(5, 1, 2, 0, 0, {0, 0b00011011, 0b11000000}));
  EXPECT_EQ(read_ids(folder + "/b.png").pixels, (std::vector<std::uint16_t>{0, 1, 2, 3, 3}));
}

TEST(Png, AlphaOverBackgroundOrDropped) {
  const std::string path = fresh_folder("i") + "/a.png";
  put_bytes(path, png_of(2, 1, 8, 6, 0, {0, 100, 50, 0, 255, 200, 100, 0, 51}));
  EXPECT_EQ(read_rgb(path, -1).pixels, (std::vector<std::uint8_t>{100, 50, 0, 200, 100, 0}));
  EXPECT_EQ(read_rgb(path, 255).pixels, (std::vector<std::uint8_t>{100, 50, 0, 244, 224, 204}));
}

TEST(Png, EveryTruncationIsNamed) {
  const std::string path = fresh_folder("i") + "/a.png";
  write_png_rgb(path, 20, 20, noise(1200));
  const std::vector<std::uint8_t> whole = bytes_of(path);
  for (std::size_t length = 0; length < whole.size(); length += 7) {
    put_bytes(path, {whole.begin(), whole.begin() + static_cast<std::ptrdiff_t>(length)});
    const std::string message = error_of([&] { (void)read_rgb(path); });
    EXPECT_HAS(message, path) << length << ": " << message;
  }
}

TEST(Png, EveryFlippedByteIsSeenOrHarmless) {
  const std::string path = fresh_folder("i") + "/a.png";
  write_png_gray8(path, 9, 9, noise(81));
  const std::vector<std::uint8_t> whole = bytes_of(path);
  for (std::size_t at = 0; at < whole.size(); ++at) {
    std::vector<std::uint8_t> bad = whole;
    bad[at] ^= 0x10;
    EXPECT_THROW((void)decode_png(std::as_bytes(std::span(bad))), Error) << at;
  }
}

TEST(Png, LyingHeaderIsRefusedBeforeAllocation) {
  const std::string path = fresh_folder("i") + "/a.png";
  put_bytes(path, png_of(65535, 65535, 8, 2, 0, {1, 2, 3}));
  EXPECT_EQ(
      error_of([&] { (void)read_rgb(path); }),
      "'" + path +
          "': image of 65535 x 65535 pixels: 65535 pixels along an axis; at most 16384 are read; check that it is the "
          "right file, or raise limits.image_axis_px in the configuration");
  put_bytes(path, png_of(16000, 16000, 8, 2, 0, {1, 2, 3}));
  EXPECT_HAS(error_of([&] { (void)read_rgb(path); }), "cannot hold 768016000 bytes of pixels");
  put_bytes(path, png_of(0, 7, 8, 2, 0, {1}));
  EXPECT_HAS(error_of([&] { (void)image_size(path); }), "image has no pixels (0 x 7)");
}

TEST(Images, ColouredPictureOfIdsIsRefused) {
  const std::string path = fresh_folder("i") + "/a.png";
  write_png_rgb(path, 2, 2, noise(12));
  EXPECT_EQ(error_of([&] { (void)read_ids(path); }),
            "'" + path +
                "': expected one channel of ids, the image has 3; export ids or millimetres as a grey or "
                "palette PNG, not a coloured picture of them");
}

TEST(Images, MissingFileAndNoImage) {
  const std::string folder = fresh_folder("i");
  EXPECT_EQ(error_of([&] { (void)read_rgb(folder + "/none.png"); }),
            "cannot open '" + folder + "/none.png': No such file or directory; check the path");
  write_file_atomic(folder + "/text.png", std::string_view("this is no image"));
  EXPECT_HAS(error_of([&] { (void)read_rgb(folder + "/text.png"); }), folder + "/text.png");
}

TEST(Images, TruncatedJpegIsAnErrorNamingTheFile) {
  const std::string source = std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/studio_room/images/0001.jpg";
  if (!images_available() || !std::filesystem::exists(source))
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
  info.classes = ClassTable({{0, "void", {}, true},
                             {1, "west", {1, 2, 3}, false},
                             {2, "east", {}, false},
                             {3, "up", {}, false},
                             {40, "down", {}, false},
                             {50, "south", {}, false},
                             {600, "north", {}, false}});
  for (int i = 0; i < frames; ++i) {
    FrameInfo f{.name = "rgb_" + std::to_string(i)};
    f.source = "somewhere/" + f.name;
    f.camera = room_camera(12, 9);
    f.camera.k1 = 0.01 * i;
    f.world_from_camera = room_pose(i);
    f.split = i % 2 == 0 ? Split::train : Split::test;
    info.frames.push_back(f);
  }
  return info;
}

void render(const SceneInfo& info, int i, FrameBuffer& out) {
  out = render_room(info.frames[i].camera, info.frames[i].world_from_camera);
  if (i == 1) out.depth_m.clear();
  if (i == 2) out.label.clear();
  if (i == 0) out.label[5] = kVoid;
}

std::string packed_room(const std::string& folder, const PackOptions& options, int frames = 3) {
  const std::string path = folder + "/room.semfield";
  const SceneInfo info = room_info(frames);
  write_packed_scene(
      path, info, [&](int i, FrameBuffer& out) { render(info, i, out); }, options);
  return path;
}

TEST(PackedScene, ALimitIsKeptAndNoLimitTakesNoBytes) {
  const std::string path = fresh_folder("l") + "/room.semfield";
  SceneInfo info = room_info(2);
  const auto pack = [&] {
    write_packed_scene(path, info, [&](int i, FrameBuffer& out) { render(info, i, out); }, {});
    return std::filesystem::file_size(path);
  };
  const auto without = pack();
  EXPECT_TRUE(PackedScene(path).info().limit.empty());
  info.limit = {{-3, -2, -1}, {3, 2, 1}};
  EXPECT_EQ(pack(), without + 6 * sizeof(double));
  EXPECT_EQ(PackedScene(path).info().limit.lo, info.limit.lo);
  EXPECT_EQ(PackedScene(path).info().limit.hi, info.limit.hi);
}

TEST(PackedScene, RoundTripIsExact) {
  PackOptions options{.depth_as_mm = false};
  const PackedScene scene(packed_room(fresh_folder("p"), options));
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
  const PackedScene scene(packed_room(fresh_folder("p"), {}));
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

TEST(PackedScene, MessagesAreExact) {
  const std::string folder = fresh_folder("p");
  const std::string path = packed_room(folder, {}, 2);
  std::string bytes = read_text_file(path);
  EXPECT_EQ(error_of([&] { PackedScene("nowhere.semfield"); }),
            "cannot open 'nowhere.semfield': No such file or directory; check the path");
  write_file_atomic(folder + "/text", std::string_view("no scene"));
  EXPECT_EQ(error_of([&] { PackedScene(folder + "/text"); }),
            "'" + folder + "/text': not a packed scene; give a file that 'semfield pack' wrote");
  const std::size_t size = bytes.size();
  bytes[70] = static_cast<char>(bytes[70] ^ 1);  // the first chunk, right behind the header
  write_file_atomic(path, bytes);
  const PackedScene scene(path);  // the manifest is whole; the chunk shows it when it is read
  FrameBuffer out;
  EXPECT_EQ(error_of([&] { scene.read(0, out); }),
            "'" + path +
                "': frame 'rgb_0': colour is damaged (wrong checksum); copy the file again, or pack the scene again");
  cut(path, 10);
  EXPECT_EQ(error_of([&] { PackedScene{path}; }), "'" + path + "': holds " + std::to_string(size - 10) +
                                                      " bytes, its header says " + std::to_string(size) +
                                                      "; copy the file again");
}

TEST(PackedScene, ParallelReadsAgree) {
  const PackedScene scene(packed_room(fresh_folder("p"), {}, 8));
  std::vector<FrameBuffer> serial(8), parallel(8);
  for (int i = 0; i < 8; ++i) scene.read(i, serial[i]);
  parallel_for(8, [&](std::int64_t i) { scene.read(static_cast<int>(i), parallel[i]); });
  for (std::size_t i = 0; i < 8; ++i) {
    EXPECT_EQ(serial[i].rgb, parallel[i].rgb);
    EXPECT_EQ(serial[i].depth_m, parallel[i].depth_m);
  }
}

TEST(PackedScene, FailingSourceLeavesNoFile) {
  const std::string folder = fresh_folder("p");
  const SceneInfo info = room_info(2);
  EXPECT_THROW(
      write_packed_scene(folder + "/a", info,
                         [](int, FrameBuffer&) { throw Error(ErrorKind::data, "test.error.made", "broken frame"); }),
      Error);
  EXPECT_TRUE(std::filesystem::is_empty(folder));
}

}  // namespace
}  // namespace semfield
