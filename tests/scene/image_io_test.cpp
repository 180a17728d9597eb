// Images: round trips, ids unchanged, damage named, area resize.
#include "formats/image_io.h"

#include <gtest/gtest.h>

#include <cstring>
#include <numeric>

#include "formats/png_codec.h"
#include "system/files.h"
#include "tests/scene/png_bytes.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using testing_room::error_of;
using testing_room::fresh_folder;
using testing_room::png_of;

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
  // Two bits a sample.
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
    EXPECT_NE(message.find(path), std::string::npos) << length << ": " << message;
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
  EXPECT_NE(error_of([&] { (void)read_rgb(path); }).find("cannot hold 768016000 bytes of pixels"), std::string::npos);
  put_bytes(path, png_of(0, 7, 8, 2, 0, {1}));
  EXPECT_NE(error_of([&] { (void)image_size(path); }).find("image has no pixels (0 x 7)"), std::string::npos);
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
  EXPECT_NE(error_of([&] { (void)read_rgb(folder + "/text.png"); }).find(folder + "/text.png"), std::string::npos);
}

TEST(Images, TruncatedJpegIsAnErrorNamingTheFile) {
  const std::string source = std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/studio_room/images/0001.jpg";
  if (!images_available() || !std::filesystem::exists(source))
    GTEST_SKIP() << "needs OpenImageIO and a JPEG of the optional studio room";
  const std::string path = fresh_folder("i") + "/a.jpg";
  write_file_atomic(path, read_text_file(source));  // not its mode: the original may be read-only
  EXPECT_EQ(read_rgb(path).width_px, 960);
  testing_room::cut(path, 5000);
  EXPECT_NE(error_of([&] { (void)read_rgb(path); }).find("'" + path + "': JPEG is truncated: it ends after "),
            std::string::npos);
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

}  // namespace
}  // namespace semfield
