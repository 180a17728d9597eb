// Pictures as the page gets them: JPEG, and PNG of labels with transparency.
#include <gtest/gtest.h>
#include <turbojpeg.h>

#include <cstdlib>

#include "app/serve/jpeg.h"

namespace semfield::app {
namespace {

std::vector<std::uint8_t> decoded(const std::vector<std::uint8_t>& jpeg, int& width, int& height) {
  const tjhandle decoder = tjInitDecompress();
  int sampling = 0, space = 0;
  EXPECT_EQ(tjDecompressHeader3(decoder, jpeg.data(), jpeg.size(), &width, &height, &sampling, &space), 0);
  std::vector<std::uint8_t> rgb(static_cast<std::size_t>(3 * width * height));
  EXPECT_EQ(tjDecompress2(decoder, jpeg.data(), jpeg.size(), rgb.data(), width, 0, height, TJPF_RGB, 0), 0);
  tjDestroy(decoder);
  return rgb;
}

TEST(Jpeg, APictureComesBackNearlyTheSame) {
  for (const auto& [w, h] : {std::pair{1, 1}, {33, 7}, {320, 240}}) {
    std::vector<std::uint8_t> rgb(static_cast<std::size_t>(3 * w * h));
    for (int y = 0; y < h; ++y)
      for (int x = 0; x < w; ++x) {
        std::uint8_t* p = &rgb[static_cast<std::size_t>(3 * (y * w + x))];
        p[0] = static_cast<std::uint8_t>(255 * x / w);
        p[1] = static_cast<std::uint8_t>(255 * y / h);
        p[2] = 60;
      }
    int width = 0, height = 0;
    const std::vector<std::uint8_t> back = decoded(encode_jpeg(w, h, rgb), width, height);
    ASSERT_EQ(width, w);
    ASSERT_EQ(height, h);
    for (std::size_t i = 0; i < rgb.size(); ++i) ASSERT_NEAR(back[i], rgb[i], 24) << w << "x" << h << " at " << i;
  }
}

}  // namespace
}  // namespace semfield::app
