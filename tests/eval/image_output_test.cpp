// Rendered maps: files read back, ids kept, colours even.
#include "eval/image_output.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <limits>

#include "core/error.h"
#include "formats/image_io.h"
#include "system/files.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
constexpr float kInf = std::numeric_limits<float>::infinity();

class ImageOutput : public ::testing::Test {
 protected:
  void SetUp() override {
    std::string name = (fs::temp_directory_path() / "semfield_image_XXXXXX").string();
    ASSERT_NE(::mkdtemp(name.data()), nullptr);
    path_ = name;
    if (!images_available()) GTEST_SKIP() << "this build cannot read images back (SEMFIELD_WITH_IMAGES=OFF)";
  }
  void TearDown() override { fs::remove_all(path_); }
  std::string in(const std::string& name) const { return path_ + "/" + name; }
  std::string path_;
};

// OKLab lightness and coordinates of an sRGB colour [Ottosson20].
std::array<double, 3> oklab(std::array<std::uint8_t, 3> color) {
  double c[3];
  for (std::size_t i = 0; i < 3; ++i) {
    const double v = color[i] / 255.0;
    c[i] = v <= 0.04045 ? v / 12.92 : std::pow((v + 0.055) / 1.055, 2.4);
  }
  const double l = std::cbrt(0.4122214708 * c[0] + 0.5363325363 * c[1] + 0.0514459929 * c[2]);
  const double m = std::cbrt(0.2119034982 * c[0] + 0.6806995451 * c[1] + 0.1073969566 * c[2]);
  const double s = std::cbrt(0.0883024619 * c[0] + 0.2817188376 * c[1] + 0.6299787005 * c[2]);
  return {0.2104542553 * l + 0.7936177850 * m - 0.0040720468 * s,
          1.9779984951 * l - 2.4285922050 * m + 0.4505937099 * s,
          0.0259040371 * l + 0.7827717662 * m - 0.8086757660 * s};
}

TEST(PerceptualMap, LightnessRisesEvenlyAndStepsLookEqual) {
  double smallest = 1e9, largest = 0;
  for (int i = 0; i < 32; ++i) {
    const auto a = oklab(perceptual_color(i / 32.0));
    const auto b = oklab(perceptual_color((i + 1) / 32.0));
    EXPECT_NEAR(a[0], 0.22 + 0.73 * i / 32, 0.01) << i;
    EXPECT_GT(b[0], a[0]);
    const double step = std::hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2]);
    smallest = std::min(smallest, step);
    largest = std::max(largest, step);
  }
  EXPECT_LT(largest / smallest, 1.35);
  EXPECT_EQ(perceptual_color(-1), perceptual_color(0));
  EXPECT_EQ(perceptual_color(kInf), perceptual_color(1));
  EXPECT_EQ(perceptual_color(kNan), (std::array<std::uint8_t, 3>{0, 0, 0}));
}

ClassTable classes(std::int32_t last_id) {
  return ClassTable(
      {{0, "void", {9, 8, 7}, true}, {3, "wall", {10, 20, 30}, false}, {last_id, "lamp", {200, 100, 50}, false}});
}

TEST_F(ImageOutput, LabelsCarryOriginalIds) {
  const std::vector<std::int16_t> label{0, 1, kVoid, 1};
  for (std::int32_t last : {40, 1000}) {
    write_label_ids(in("label.png"), {2, 2}, label, classes(last));
    write_label_colors(in("vis.png"), {2, 2}, label, classes(last));
    const Image<std::uint16_t> ids = read_ids(in("label.png"));
    const auto id = static_cast<std::uint16_t>(last);
    EXPECT_EQ(ids.pixels, (std::vector<std::uint16_t>{3, id, 0, id}));
    EXPECT_EQ(image_size(in("label.png")).bits, last > 254 ? 16 : 8);
    EXPECT_EQ(read_rgb(in("vis.png")).pixels,
              (std::vector<std::uint8_t>{10, 20, 30, 200, 100, 50, 9, 8, 7, 200, 100, 50}));
  }
  write_label_colors(in("palette.png"), {2, 2}, label, classes(40));
  EXPECT_EQ(read_ids(in("palette.png")).pixels, (std::vector<std::uint16_t>{3, 40, 0, 40}));
  EXPECT_THROW(write_label_ids(in("bad.png"), {2, 1}, std::vector<std::int16_t>{0, 2}, classes(40)), Error);
  EXPECT_THROW(write_label_ids(in("bad.png"), {2, 1}, std::vector<std::int16_t>{0, 1}, classes(70000)), Error);
  EXPECT_FALSE(fs::exists(in("bad.png")));
}

TEST_F(ImageOutput, DepthInMillimetres) {
  const std::vector<float> depth{1.2345f, 0, kNan, 65.535f, 65.6f, -1, kInf, 0.0004f};
  EXPECT_EQ(write_depth_mm(in("d.png"), {4, 2}, depth), 2);
  EXPECT_EQ(read_ids(in("d.png")).pixels, (std::vector<std::uint16_t>{1235, 0, 0, 65535, 0, 0, 0, 0}));
}

TEST_F(ImageOutput, EntropyUsesTheFullRange) {
  const float most = static_cast<float>(std::log(8.0));
  write_entropy(in("e.png"), {4, 1}, std::vector<float>{0, most, most / 2, -1e-9f}, 8);
  const auto values = read_ids(in("e.png")).pixels;
  EXPECT_EQ(values[0], 0);
  EXPECT_EQ(values[1], 65535);
  EXPECT_NEAR(values[2], 32768, 1);
  EXPECT_EQ(values[3], 0);
  write_entropy(in("one.png"), {1, 1}, std::vector<float>{0}, 1);
  EXPECT_EQ(read_ids(in("one.png")).pixels[0], 0);
}

TEST_F(ImageOutput, ColoursRoundAndNanIsNamed) {
  write_color(in("c.png"), {2, 1}, std::vector<float>{0, 0.5f, 1, -1, 2, 0.2f});
  EXPECT_EQ(read_rgb(in("c.png")).pixels, (std::vector<std::uint8_t>{0, 128, 255, 0, 255, 51}));
  try {
    (void)to_bytes(std::vector<float>{0, 0, 0, 0, kNan, 0});
    FAIL();
  } catch (const Error& error) {
    EXPECT_NE(std::string(error.what()).find("pixel 1, channel 1"), std::string::npos);
  }
}

TEST_F(ImageOutput, NpyHoldsTheFloats) {
  write_map_npy(in("m.npy"), {3, 2}, std::vector<float>{1, 2, 3, 4, 5, 6});
  const std::string file = read_text_file(in("m.npy"));
  EXPECT_EQ(file.substr(1, 5), "NUMPY");
  EXPECT_NE(file.find("'shape': (2, 3)"), std::string::npos);
  float last = 0;
  std::memcpy(&last, file.data() + file.size() - 4, 4);
  EXPECT_EQ(last, 6.0f);
}

TEST(DepthColors, NearIsBrightAndInvalidIsBlack) {
  const std::vector<float> depth{1, 5, 0, kNan};
  const auto rgb = depth_colors(depth, 1, 5);
  EXPECT_GT(rgb[0] + rgb[1] + rgb[2], rgb[3] + rgb[4] + rgb[5]);
  for (std::size_t i = 6; i < 12; ++i) EXPECT_EQ(rgb[i], 0);
  std::vector<float> many;
  for (int i = 100; i >= 0; --i) many.push_back(static_cast<float>(i));
  const DepthRange range = robust_depth_range(many);
  EXPECT_EQ(range.near_m, 2);  // rank floor(0.02 * 99) of 1..100
  EXPECT_EQ(range.far_m, 98);
  EXPECT_EQ(robust_depth_range(std::vector<float>{0, kNan}).far_m, 1);
}

}  // namespace
}  // namespace semfield
