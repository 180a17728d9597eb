// Labels of a coarse map brought to a photograph's size: exact at stride 1, along edges of colour elsewhere.
#include "serve/label_upsampling.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "compute/parallel.h"
#include "core/rng.h"
#include "serve/label_loop.h"

namespace semfield {
namespace {

StoredFrame photo_of(std::int32_t width, std::int32_t height) {
  StoredFrame photo;
  photo.width_px = width;
  photo.height_px = height;
  photo.rgb.assign(static_cast<std::size_t>(3 * width * height), 128);
  return photo;
}

CoarseLabels coarse_of(const StoredFrame& photo, std::int32_t stride) {
  CoarseLabels coarse;
  coarse.stride = stride;
  coarse.width_px = strided_px(photo.width_px, stride);
  coarse.height_px = strided_px(photo.height_px, stride);
  coarse.label.assign(static_cast<std::size_t>(coarse.width_px * coarse.height_px), 0);
  coarse.entropy.assign(coarse.label.size(), 0);
  return coarse;
}

TEST(LabelUpsampling, StrideOneIsTheIdentity) {
  const StoredFrame photo = photo_of(7, 5);
  CoarseLabels coarse = coarse_of(photo, 1);
  for (std::size_t i = 0; i < coarse.label.size(); ++i) {
    coarse.label[i] = static_cast<std::int16_t>(i % 4) - 1;
    coarse.entropy[i] = static_cast<std::uint8_t>(7 * i);
  }
  const ViewLabels out = upsampled(coarse, photo);
  EXPECT_EQ(out.width_px, 7);
  EXPECT_EQ(out.height_px, 5);
  EXPECT_EQ(out.label, coarse.label);
  EXPECT_EQ(out.entropy, coarse.entropy);
}

TEST(LabelUpsampling, WithoutAMapNothingIsNamed) {
  const ViewLabels out = upsampled({}, photo_of(6, 4));
  EXPECT_EQ(out.label, std::vector<std::int16_t>(24, kVoid));
  EXPECT_EQ(out.entropy, std::vector<std::uint8_t>(24, 0));
}

// An edge of colour between two samples of the map, wherever it lies.
TEST(LabelUpsampling, LabelsFollowAnEdgeOfColour) {
  for (const std::int32_t stride : {3, 4, 6}) {
    for (std::int32_t edge = 12 + stride / 2 + 1; edge <= 12 + stride / 2 + stride; ++edge) {
      StoredFrame photo = photo_of(36, 24);
      for (std::int32_t y = 0; y < 24; ++y)
        for (std::int32_t x = edge; x < 36; ++x) photo.rgb[static_cast<std::size_t>(3 * (y * 36 + x))] = 220;
      CoarseLabels coarse = coarse_of(photo, stride);
      for (std::size_t i = 0; i < coarse.label.size(); ++i) {
        const PixelPlace at = strided_place(static_cast<std::int64_t>(i), coarse.width_px, stride);
        coarse.label[i] = at.column < edge ? 3 : 8;
      }
      const ViewLabels out = upsampled(coarse, photo);
      for (std::int32_t y = 0; y < 24; ++y)
        for (std::int32_t x = 0; x < 36; ++x)
          ASSERT_EQ(out.label[static_cast<std::size_t>(y * 36 + x)], x < edge ? 3 : 8)
              << "stride " << stride << ", edge " << edge << ", pixel " << x << ", " << y;
    }
  }
}

// Sizes that no stride divides, random colours: what comes out is between what is around, for any threads.
TEST(LabelUpsampling, LabelsAndEntropyAreThoseOfTheNeighbours) {
  const RandomAddress random{3, 0, stream_id("label_upsampling_test")};
  StoredFrame photo = photo_of(29, 22);
  for (std::size_t i = 0; i < photo.rgb.size(); ++i)
    photo.rgb[i] = static_cast<std::uint8_t>(uniform_below(random, i, 256));
  CoarseLabels coarse = coarse_of(photo, 4);
  for (std::size_t i = 0; i < coarse.label.size(); ++i) {
    coarse.label[i] = static_cast<std::int16_t>(uniform_below(random, 10000 + i, 5)) - 1;
    coarse.entropy[i] = static_cast<std::uint8_t>(uniform_below(random, 20000 + i, 256));
  }
  const ViewLabels out = upsampled(coarse, photo);
  for (std::int32_t y = 0; y < 22; ++y) {
    for (std::int32_t x = 0; x < 29; ++x) {
      std::vector<std::int16_t> labels;
      std::vector<std::uint8_t> entropies;
      for (int k = 0; k < 4; ++k) {
        const auto side = [](std::int32_t at, std::int32_t count, int next) {
          return std::clamp(static_cast<std::int32_t>(std::floor((at - 2) / 4.0)) + next, 0, count - 1);
        };
        const std::int32_t cx = side(x, coarse.width_px, k % 2), cy = side(y, coarse.height_px, k / 2);
        labels.push_back(coarse.label[static_cast<std::size_t>(cy * coarse.width_px + cx)]);
        entropies.push_back(coarse.entropy[static_cast<std::size_t>(cy * coarse.width_px + cx)]);
      }
      const auto at = static_cast<std::size_t>(y * 29 + x);
      EXPECT_NE(std::find(labels.begin(), labels.end(), out.label[at]), labels.end()) << x << ", " << y;
      EXPECT_GE(out.entropy[at], *std::min_element(entropies.begin(), entropies.end())) << x << ", " << y;
      EXPECT_LE(out.entropy[at], *std::max_element(entropies.begin(), entropies.end())) << x << ", " << y;
      const bool sample = x % 4 == 2 && y % 4 == 2;
      if (sample && x / 4 < coarse.width_px && y / 4 < coarse.height_px) {
        EXPECT_EQ(out.label[at], labels[0]);
      }
    }
  }
  for (const int threads : {1, 3}) {
    set_thread_count(threads);
    const ViewLabels again = upsampled(coarse, photo);
    EXPECT_EQ(again.label, out.label);
    EXPECT_EQ(again.entropy, out.entropy);
  }
  set_thread_count(0);
}

}  // namespace
}  // namespace semfield
