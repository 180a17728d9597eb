// Labels that cling to a photograph, against a plain filter in double precision and by hand; what is beside a border,
// and what a speck is.

#include "eval/photo_edges.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "core/rng.h"
#include "eval/evaluator.h"
#include "eval/metrics.h"
#include "formats/image_io.h"
#include "scene/scene.h"
#include "tests/temp_dir.h"
#include "tests/threads.h"

namespace semfield {
namespace {

using Bytes = std::vector<std::uint8_t>;
constexpr int kColumns = PhotoEdges::kColumns;

Bytes noisy_photo(int width, int height) {
  const RandomAddress random{3, 0, stream_id("photo_edges_test")};
  Bytes rgb(static_cast<std::size_t>(3 * width * height));
  for (std::size_t i = 0; i < rgb.size(); ++i) rgb[i] = static_cast<std::uint8_t>(uniform_below(random, i, 256));
  return rgb;
}

// The filter as its text says it [Gastal11, Eq. 14, 21], without any table.
std::vector<double> plain(const Bytes& rgb, int width, int height, std::vector<double> values) {
  const auto blurred = [&](int x, int y, int c) {
    if (std::max(width, height) < 400) return rgb[3 * (y * width + x) + c] / 255.0;
    double sum = 0;
    for (int dy = -1; dy <= 1; ++dy)
      for (int dx = -1; dx <= 1; ++dx)
        sum += (2 - std::abs(dx)) * (2 - std::abs(dy)) *
               rgb[3 * (std::clamp(y + dy, 0, height - 1) * width + std::clamp(x + dx, 0, width - 1)) + c] / 16.0;
    return sum / 255;
  };
  const double reach = 0.15 * std::max(width, height);
  for (int round = 0; round < 3; ++round) {
    const double sigma = reach * std::sqrt(3.0) * std::pow(2.0, 2 - round) / std::sqrt(63.0);
    const auto take = [&](int x, int y, int from_x, int from_y) {
      double color = 0;
      for (int c = 0; c < 3; ++c) color += std::abs(blurred(x, y, c) - blurred(from_x, from_y, c));
      const double weight = std::max(1e-9, std::exp(-std::sqrt(2.0) / sigma * (1 + reach / 0.17 * color)));
      for (int k = 0; k < kColumns; ++k) {
        double& own = values[(y * width + x) * kColumns + k];
        own += weight * (values[(from_y * width + from_x) * kColumns + k] - own);
      }
    };
    for (int y = 0; y < height; ++y) {
      for (int x = 1; x < width; ++x) take(x, y, x - 1, y);
      for (int x = width - 2; x >= 0; --x) take(x, y, x + 1, y);
    }
    for (int x = 0; x < width; ++x) {
      for (int y = 1; y < height; ++y) take(x, y, x, y - 1);
      for (int y = height - 2; y >= 0; --y) take(x, y, x, y + 1);
    }
  }
  return values;
}

void expect_plain(int width, int height) {
  const RandomAddress random{4, 0, stream_id("photo_edges_test")};
  Bytes rgb = noisy_photo(width, height);
  for (std::uint8_t& value : rgb) value = static_cast<std::uint8_t>(value / 24);  // soft enough to let values through
  std::vector<float> values(width * height * kColumns);
  for (std::size_t i = 0; i < values.size(); ++i) values[i] = uniform01(random, i);
  const std::vector<double> expected = plain(rgb, width, height, {values.begin(), values.end()});
  std::vector<float> first;
  for (const int threads : {1, 2, 5}) {
    const ThreadScope scope(threads);
    std::vector<float> found = values;
    PhotoEdges(rgb, width, height).spread(found);
    if (first.empty()) first = found;
    EXPECT_EQ(found, first) << threads << " threads";
  }
  double moved = 0;
  for (std::size_t i = 0; i < first.size(); ++i) {
    EXPECT_NEAR(first[i], expected[i], 2e-6);
    moved = std::max(moved, std::abs(static_cast<double>(first[i] - values[i])));
  }
  EXPECT_GT(moved, 0.2);
}

TEST(PhotoEdges, SpreadAsThePlainFilterDoesOnAnyNumberOfThreads) {
  expect_plain(45, 38);
  expect_plain(410, 21);  // fine pixels, which are smoothed
}

// Probabilities of classes 3 and 8 at every stride-th pixel; what lies right of `edge` is 8.
struct TwoClasses {
  TwoClasses(int width, int height, std::int32_t stride, int edge) {
    evidence = {stride, strided_px(width, stride), strided_px(height, stride), {}, {3, 8}};
    for (std::int64_t i = 0; i < std::int64_t{evidence.width_px} * evidence.height_px; ++i) {
      const bool left = strided_place(i, evidence.width_px, stride).column < edge;
      rows.push_back(left ? 0.9F : 0.1F);
      rows.push_back(left ? 0.1F : 0.9F);
    }
  }
  PhotoLabels on(const Bytes& rgb, int width, int height) {
    evidence.probability = rows;
    return labels_on_photo(evidence, rgb, width, height);
  }
  ClassEvidence evidence;
  std::vector<float> rows;
};

Bytes two_colors(int width, int height, int edge) {
  Bytes rgb(static_cast<std::size_t>(3 * width * height), 90);
  for (int i = 0; i < width * height; ++i)
    if (i % width >= edge) rgb[3 * i] = 230;
  return rgb;
}

// Between two known pixels, and some pixels off where the classes change: the photograph says where.
// Class 3 left of `edge` and 8 right of it, but for the pixel on either side: noise of one pixel is blurred, and edges
// with it.
void expect_edge(const PhotoLabels& found, int width, int edge) {
  int wrong = 0;
  for (int i = 0; i < static_cast<int>(found.label.size()); ++i) {
    const int x = i % width;
    if (x == edge || x == edge - 1) continue;
    wrong += found.label[i] == (x < edge ? 3 : 8) ? 0 : 1;
  }
  EXPECT_EQ(wrong, 0);
}

// Between two known pixels, and some pixels off where the classes change: the photograph says where.
TEST(PhotoLabels, FollowAnEdgeOfColour) {
  constexpr int kWidth = 72, kHeight = 48;
  for (const std::int32_t stride : {1, 3, 4, 6}) {
    // Edges between the same two known pixels as the classes' own; of every pixel, up to two pixels off.
    const int before = (32 - stride / 2) / stride * stride + stride / 2, after = before + stride;
    for (int edge = stride == 1 ? 31 : before + 1; edge <= (stride == 1 ? 35 : after); ++edge) {
      SCOPED_TRACE(testing::Message() << "stride " << stride << ", edge " << edge);
      expect_edge(TwoClasses(kWidth, kHeight, stride, 33).on(two_colors(kWidth, kHeight, edge), kWidth, kHeight),
                  kWidth, edge);
    }
  }
}

TEST(PhotoLabels, OfALargerPhotographLieWhereTheFrameHasThem) {
  constexpr int kWidth = 144, kHeight = 96;
  TwoClasses known(72, 48, 2, 33);
  known.evidence.frame_width_px = 72;
  known.evidence.frame_height_px = 48;
  expect_edge(known.on(two_colors(kWidth, kHeight, 67), kWidth, kHeight), kWidth, 67);
}

TEST(PhotoLabels, HaveNoSpecksButKeepSmallThingsThatAreSure) {
  constexpr int kWidth = 100, kHeight = 80;
  Bytes rgb(3 * kWidth * kHeight, 128);
  TwoClasses known(kWidth, kHeight, 1, kWidth);
  const auto is_thing = [](int x, int y) { return x >= 60 && x < 66 && y >= 30 && y < 37; };
  const auto is_doubtful = [](int x, int y) { return x >= 20 && x < 26 && y >= 30 && y < 37; };
  for (int y = 0; y < kHeight; ++y) {
    for (int x = 0; x < kWidth; ++x) {
      const int i = y * kWidth + x;
      float* const row = &known.rows[2 * i];
      if ((x * 7 + y * 13) % 97 == 0) std::swap(row[0], row[1]);
      if (is_thing(x, y)) row[0] = 0, row[1] = 1;
      if (is_doubtful(x, y)) row[0] = 0.35F, row[1] = 0.4F;
      if (is_thing(x, y) || is_doubtful(x, y)) rgb[3 * i] = 255, rgb[3 * i + 1] = 0;
    }
  }
  const PhotoLabels found = known.on(rgb, kWidth, kHeight);
  for (int i = 0; i < kWidth * kHeight; ++i)
    ASSERT_EQ(found.label[i], is_thing(i % kWidth, i / kWidth) ? 8 : 3) << i % kWidth << ", " << i / kWidth;
}

// A post that the photograph does not show. Rays are believed where little else is doubted, and pixels are coarse.
TEST(PhotoLabels, OfCoarsePicturesKeepWhatIsThinAndSure) {
  for (const int width : {100, 440}) {
    for (const int noise : {0, 25}) {  // of so many pixels one is wrong
      const int height = width * 4 / 5;
      const Bytes grey(static_cast<std::size_t>(3 * width * height), 128);
      TwoClasses known(width, height, 1, width);
      const auto is_post = [&](int i) { return i % width / 2 == width / 4 && i / width >= height / 4; };
      for (int i = 0; i < width * height; ++i)
        if (is_post(i) || (noise > 0 && (7 * (i % width) + 13 * (i / width)) % noise == 0))
          known.rows[2 * i] = 0, known.rows[2 * i + 1] = 1;
      const PhotoLabels found = known.on(grey, width, height);
      int kept = 0, posts = 0, wrong = 0;
      for (int i = 0; i < width * height; ++i) {
        posts += is_post(i) ? 1 : 0;
        kept += is_post(i) && found.label[i] == 8 ? 1 : 0;
        wrong += !is_post(i) && found.label[i] == 8 ? 1 : 0;
      }
      EXPECT_EQ(kept, width == 100 && noise == 0 ? posts : 0) << width << ", " << noise;
      EXPECT_EQ(wrong, 0) << width << ", " << noise;
    }
  }
}

// A column without a class, rows that say nothing, classes that are nowhere.
TEST(PhotoLabels, ProbabilitiesAreThoseOfWhatIsKnown) {
  constexpr int kWidth = 24, kHeight = 20;
  ClassEvidence evidence{1, kWidth, kHeight, {}, {}};
  for (int c = 0; c < 11; ++c) evidence.label.push_back(static_cast<std::int16_t>(c));
  evidence.label.push_back(-1);
  std::vector<float> rows;
  for (int i = 0; i < kWidth * kHeight; ++i) {
    std::vector<float> row(12, 0);
    if (i % 3 == 0) row[9] = 0.75F, row[11] = 0.25F;
    rows.insert(rows.end(), row.begin(), row.end());
  }
  evidence.probability = rows;
  const Bytes grey(3 * kWidth * kHeight, 50);
  const PhotoLabels found = labels_on_photo(evidence, grey, kWidth, kHeight);
  for (std::size_t i = 0; i < found.label.size(); ++i) {
    EXPECT_EQ(found.label[i], 9);
    EXPECT_NEAR(found.confidence[i], 0.75F, 1e-5);
    EXPECT_NEAR(found.entropy[i], 0.5623351, 1e-5);
  }
  for (float& value : rows) value = 0;
  evidence.probability = rows;
  const PhotoLabels none = labels_on_photo(evidence, grey, kWidth, kHeight);
  EXPECT_EQ(std::count(none.label.begin(), none.label.end(), std::int16_t{-1}), std::ssize(none.label));
}

// A frame whose photograph has its edge at column 200 and whose rendered colour has it at 220; the classes change at 210.
struct ClingingFrame {
  TempDir dir;
  FrameInfo info;
  RenderedFrame rendered;
  ClingingFrame() {
    rendered.width_px = 480;
    rendered.height_px = 360;
    for (const std::uint8_t value : two_colors(480, 360, 220)) rendered.rgb.push_back(static_cast<float>(value) / 255.0F);
    for (int i = 0; i < 480 * 360; ++i) {
      const bool left = i % 480 < 210;
      rendered.label.push_back(left ? 0 : 1);
      rendered.probability.push_back(left ? 0.8F : 0.2F);
      rendered.probability.push_back(left ? 0.2F : 0.8F);
    }
    info.source = dir / "photo.png";
  }
  // The column of the border with a photograph of this size, whose edge is at this column.
  int border(int width, int height, int edge) {
    write_png_rgb(info.source, width, height, two_colors(width, height, edge));
    return border(&info);
  }
  int border(const FrameInfo* of) const {
    const std::vector<std::int16_t> label = clinging_labels(of, rendered, 2, 480, 360);
    const auto row = label.begin() + 180 * 480;
    return static_cast<int>(std::find(row, row + 480, 1) - row);
  }
};

TEST(PhotoLabels, TakeTheRenderedColourWhereNoPhotographFits) {
  ClingingFrame frame;
  EXPECT_NEAR(frame.border(480, 360, 200), 200, 1);
  EXPECT_NEAR(frame.border(960, 720, 400), 200, 1) << "larger: made smaller";
  EXPECT_NEAR(frame.border(240, 180, 100), 220, 1) << "smaller";
  EXPECT_NEAR(frame.border(360, 480, 150), 220, 1) << "turned";
  frame.info.source.clear();
  EXPECT_NEAR(frame.border(&frame.info), 220, 1) << "no file";
  EXPECT_NEAR(frame.border(nullptr), 220, 1) << "no frame";
  frame.rendered.rgb.clear();
  EXPECT_EQ(frame.border(nullptr), 210) << "nothing to cling to";
}

// Classes 0 and 1 with a gap of void between them, which is a border up to eight pixels wide.
TEST(LabelDetail, BesideABorderByHand) {
  constexpr int kWidth = 40, kHeight = 3;
  for (const int gap : {0, 3, 8, 9}) {
    std::vector<std::int16_t> truth(kWidth * kHeight);
    for (int i = 0; i < kWidth * kHeight; ++i)
      truth[i] = static_cast<std::int16_t>(i % kWidth < 15 ? 0 : i % kWidth < 15 + gap ? -1 : 1);
    const std::vector<std::uint8_t> beside = beside_borders(truth, kWidth);
    const int last = 14 + (gap + 1) / 2;  // column left of the border
    for (int x = 0; x < kWidth; ++x)
      EXPECT_EQ(beside[kWidth + x] != 0, gap <= 8 && std::abs(x - last) <= 8) << "gap " << gap << ", column " << x;
  }
}

TEST(LabelDetail, SpecksAreWrongPixelsOfSmallPieces) {
  constexpr int kWidth = 40, kHeight = 30;  // a speck has fewer than 12 pixels
  std::vector<std::int16_t> truth(kWidth * kHeight, 0), predicted(truth);
  std::fill_n(truth.begin() + 10 * kWidth, kWidth, std::int16_t{-1});
  for (int x = 0; x < 11; ++x) predicted[3 * kWidth + x] = 1;  // a speck
  for (int x = 0; x < 12; ++x) predicted[6 * kWidth + x] = 1;  // wrong, and too large for one
  for (int x = 0; x < 5; ++x) predicted[10 * kWidth + x] = 1;  // of no true class
  for (int x = 20; x < 25; ++x) truth[20 * kWidth + x] = predicted[20 * kWidth + x] = 1;  // small, and right
  LabelDetail detail(2);
  detail.add(truth, predicted, kWidth);
  EXPECT_DOUBLE_EQ(*detail.specks(), 11.0 / (kWidth * (kHeight - 1)));
  LabelDetail twice(2);
  twice.merge(detail);
  twice.merge(detail);
  EXPECT_EQ(twice.specks(), detail.specks());
  EXPECT_FALSE(LabelDetail(2).specks());
}

}  // namespace
}  // namespace semfield
