// Segments from files: every form, and what is wrong with them.
#include <gtest/gtest.h>

#include "formats/image_io.h"
#include "formats/npz.h"
#include "objects/segments.h"
#include "system/files.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

constexpr std::int32_t kWidth = 4, kHeight = 3;

SceneInfo scene_info() {
  SceneInfo info;
  info.classes = ClassTable({{1, "wall", {}, false}, {2, "chair", {}, false}});
  for (const char* name : {"rgb_0", "rgb_1"}) {
    FrameInfo frame;
    frame.name = name;
    frame.source = std::string("rgb/") + name + ".jpg";
    frame.camera.width_px = kWidth;
    frame.camera.height_px = kHeight;
    info.frames.push_back(frame);
  }
  info.frames[1].split = Split::test;
  return info;
}

const std::vector<std::int32_t> kIds{0, 1, 1, 2, 0, 1, 1, 2, 0, 0, 0, 2};

TEST(ReadSegments, InstanceImagesOfEightSixteenBitsAndAPalette) {
  const std::vector<std::uint8_t> narrow(kIds.begin(), kIds.end());
  std::vector<std::uint16_t> wide(kIds.begin(), kIds.end());
  wide[0] = 65535;
  const TempDir a, b, c;
  write_png_gray8(a / "rgb_0.png", kWidth, kHeight, narrow);
  write_png_gray16(b / "rgb_0.png", kWidth, kHeight, wide);
  const std::vector<std::uint8_t> palette{0, 0, 0, 9, 9, 9, 200, 0, 0};
  write_png_palette(c / "seg_0.png", kWidth, kHeight, narrow, palette);
  EXPECT_EQ(read_segments(a.path(), "", scene_info()).frames[0].id, kIds);
  EXPECT_EQ(read_segments(b.path(), "", scene_info()).frames[0].id, kIds);
  const SegmentSet set = read_segments(c.path(), "seg_{number}.png", scene_info());
  EXPECT_EQ(set.frames[0].id, kIds);
  EXPECT_FALSE(set.classes);
  EXPECT_EQ(set.count(), 2);
}

TEST(ReadSegments, AnImageOfAnotherSizeIsReadByItsNearestPixel) {
  const TempDir dir;
  write_png_gray8(dir / "rgb_0.png", 2 * kWidth, 2 * kHeight, std::vector<std::uint8_t>(48, 7));
  const FrameSegments frame = read_segments(dir.path(), "", scene_info()).frames[0];
  EXPECT_EQ(frame.width_px, 8);
  EXPECT_EQ(frame.at(3, 2, kWidth, kHeight), 7);
}

// Orientation 6: viewers turn the image to the right, and stored pixel (x, y) is shown at (2 - y, x).
TEST(ReadSegments, OfATurnedPhotographAreThoseOfItsStoredPixels) {
  SceneInfo info = scene_info();
  info.frames[0].orientation = 6;
  std::vector<std::uint8_t> shown(kIds.size());
  for (std::size_t y = 0; y < 3; ++y)
    for (std::size_t x = 0; x < 4; ++x) shown[3 * x + 2 - y] = static_cast<std::uint8_t>(kIds[4 * y + x]);
  const TempDir dir;
  write_png_gray8(dir / "rgb_0.png", kHeight, kWidth, shown);
  const FrameSegments frame = read_segments(dir.path(), "", info).frames[0];
  EXPECT_EQ(frame.width_px, kWidth);
  EXPECT_EQ(frame.id, kIds);
}

TEST(ReadSegments, PanopticImagesHaveClassesByName) {
  const TempDir dir;
  std::vector<std::uint8_t> rgb(3 * kIds.size(), 0);
  for (std::size_t i = 0; i < kIds.size(); ++i) {
    rgb[3 * i] = static_cast<std::uint8_t>(kIds[i] == 2 ? 0 : kIds[i]);
    rgb[3 * i + 1] = kIds[i] == 2 ? 1 : 0;  // 256
  }
  std::filesystem::create_directories(dir / "panoptic");
  write_png_rgb(dir / "panoptic/rgb_0.png", kWidth, kHeight, rgb);
  const std::string file = dir.write("panoptic.json",
                                     R"({"annotations": [{"image_id": 5, "file_name": "rgb_0.png", "segments_info":
          [{"id": 1, "category_id": 3}, {"id": 256, "category_id": 4}]}],
          "categories": [{"id": 3, "name": "chair"}, {"id": 4, "name": "piano"}]})");
  const SegmentSet set = read_segments(file, "", scene_info());
  EXPECT_EQ(set.frames[0].id[1], 1);
  EXPECT_EQ(set.frames[0].id[3], 256);
  EXPECT_EQ(set.frames[0].class_of.at(1), 1);
  EXPECT_FALSE(set.frames[0].class_of.contains(256)) << "the scene has no piano";
  EXPECT_TRUE(set.classes);
}

TEST(ReadSegments, OfMasksThatOverlapTheSmallerLiesInFront) {
  const TempDir dir;
  // Column by column: all 12 pixels, and the second column alone, as counts and as a polygon.
  dir.write("rgb_0.json", R"([{"segmentation": {"size": [3, 4], "counts": [3, 3, 6]}, "area": 3},
                              {"segmentation": {"size": [3, 4], "counts": [0, 12]}},
                              {"segmentation": [[3, 0, 4, 0, 4, 1, 3, 1]]}])");
  const std::vector<std::int32_t> id = read_segments(dir.path(), "", scene_info()).frames[0].id;
  EXPECT_EQ(id, (std::vector<std::int32_t>{1, 2, 1, 3, 1, 2, 1, 1, 1, 2, 1, 1}));
}

TEST(ReadSegments, InstancesOfCoco) {
  const TempDir dir;
  const std::string file = dir.write(
      "instances.json",
      R"({"images": [{"id": 8, "file_name": "rgb_0.jpg", "width": 4, "height": 3}, {"id": 9, "file_name": "other.jpg"}],
          "annotations": [{"image_id": 8, "category_id": 2, "segmentation": {"size": [3, 4], "counts": "0<"}},
                          {"image_id": 9, "segmentation": []}],
          "categories": [{"id": 2, "name": "wall"}]})");
  const FrameSegments frame = read_segments(file, "", scene_info()).frames[0];
  EXPECT_EQ(frame.id, std::vector<std::int32_t>(12, 1));
  EXPECT_EQ(frame.class_of.at(1), 0);
}

// An array of a .npz file, whose values are one byte each.
struct ByteArray {
  std::string key, type;
  std::vector<std::int64_t> shape;
  std::string values;
};

std::string write_arrays(const TempDir& dir, const std::vector<ByteArray>& arrays) {
  ZipWriter archive(dir / "rgb_0.npz");
  for (const ByteArray& a : arrays) archive.add(a.key + ".npy", npy_header(a.type, a.shape) + a.values);
  archive.write();
  return dir.path();
}

std::string pixels(const std::string& rows) {  // 'x' is inside
  std::string out;
  for (const char c : rows) out += static_cast<char>(c == 'x' ? 1 : 0);
  return out;
}

TEST(ReadSegments, MasksOfNumPyTogetherAndOneByOne) {
  const std::string all = pixels("xxxxxxxxxxxx"), column = pixels(".x...x...x..");
  const std::vector<std::int32_t> want{1, 2, 1, 1, 1, 2, 1, 1, 1, 2, 1, 1};
  const TempDir together, apart, channel;
  const SegmentSet set = read_segments(write_arrays(together, {{"scores", "<f4", {1}, "abcd"},
                                                               {"masks", "|b1", {2, 3, 4}, column + all},
                                                               {"class_ids", "|u1", {2}, "\x02\x01"}}),
                                       "", scene_info());
  EXPECT_EQ(set.frames[0].id, want) << "the smaller mask lies in front";
  EXPECT_EQ(set.frames[0].class_of.at(2), 1) << "the column is a chair";
  EXPECT_EQ(set.frames[0].class_of.at(1), 0);
  EXPECT_TRUE(set.classes);
  const FrameSegments one_by_one =
      read_segments(write_arrays(apart, {{"m0", "|u1", {3, 4}, all}, {"m1", "|u1", {3, 4}, column}}), "", scene_info())
          .frames[0];
  EXPECT_EQ(one_by_one.id, want);
  EXPECT_TRUE(one_by_one.class_of.empty());
  const std::string four = write_arrays(channel, {{"masks", "|b1", {2, 1, 3, 4}, column + all}});
  EXPECT_EQ(read_segments(four, "{name}.npz", scene_info()).frames[0].id, want);
}

TEST(ReadSegments, WhatIsWrongWithMasksOfNumPyIsNamed) {
  const TempDir dir;
  const std::string all(12, '\1');
  const auto read = [&](const std::vector<ByteArray>& arrays) {
    return read_segments(write_arrays(dir, arrays), "", scene_info());
  };
  EXPECT_ERROR(read({{"masks", "<f4", {1, 3, 1}, all}}), "files.array.type", "rgb_0.npz", "'masks'", "bool or uint8");
  EXPECT_ERROR(read({{"masks", "|b1", {3, 4}, all}}), "labels.array.shape", "'masks'", "(3, 4)",
               "[masks, height, width]");
  EXPECT_ERROR(read({{"masks", "|b1", {1, 2, 6}, all}}), "labels.image.size", "'masks'", "6 x 2", "4 x 3");
  EXPECT_ERROR(read({{"masks", "|b1", {2, 3, 4}, all}}), "files.array.format", "'masks'", "(2, 3, 4)");
  EXPECT_ERROR(read({{"a", "|b1", {3, 4}, all}, {"b", "|b1", {6, 8}, all + all + all + all}}), "labels.array.shape",
               "'b'", "(6, 8)", "(3, 4)");
  EXPECT_ERROR(read({{"a", "|b1", {1, 3, 4}, all}}), "labels.array.shape", "'a'", "'masks'");
  EXPECT_ERROR(read({{"scores", "<f4", {3}, all}}), "labels.array.shape", "rgb_0.npz", "no masks");
  EXPECT_ERROR(read({{"masks", "|b1", {10001, 3, 4}, std::string(12 * 10001, '\0')}}), "labels.array.shape", "'masks'",
               "at most 10000 masks");
  const ByteArray masks{"masks", "|b1", {1, 3, 4}, all};
  EXPECT_ERROR(read({masks, {"class_ids", "|u1", {2}, "\1\1"}}), "labels.array.shape", "'class_ids'", "(2,)", "(1,)");
  EXPECT_ERROR(read({masks, {"class_ids", "|u1", {1}, "\7"}}), "labels.id.unknown", "'class_ids'", "mask 1", "7");
  EXPECT_ERROR(read({masks, {"class_ids", "|i1", {1}, "\xff"}}), "labels.id.unknown", "-1");
  EXPECT_ERROR(read({masks, {"class_ids", "<f4", {1}, "abcd"}}), "files.array.type", "'class_ids'", "int64");
  read({masks});
  const std::string whole = read_text_file(dir / "rgb_0.npz");
  dir.write("rgb_0.npz", whole.substr(0, whole.size() / 2));
  EXPECT_ERROR(read_segments(dir.path(), "", scene_info()), "files.zip.damaged", "rgb_0.npz");
}

TEST(ReadSegments, WhatIsWrongIsNamed) {
  const TempDir dir;
  EXPECT_ERROR(read_segments(dir / "nothing", "", scene_info()), "files.read.missing", "nothing");
  EXPECT_ERROR(read_segments(dir.path(), "", scene_info()), "objects.segments.none", "rgb_0");
  EXPECT_ERROR(read_segments(dir.write("a.json", "{"), "", scene_info()), "labels.file.format", "a.json");
  EXPECT_ERROR(read_segments(dir.write("b.json", "{}"), "", scene_info()), "labels.file.format", "annotations");
  const TempDir masks;
  masks.write("rgb_0.json", R"([{"segmentation": {"size": [3, 4], "counts": [3, 30]}}])");
  EXPECT_ERROR(read_segments(masks.path(), "", scene_info()), "labels.run_lengths.damaged", "rgb_0.json: mask 1");
  masks.write("rgb_0.json", R"([{"segmentation": {"size": [3, 40], "counts": [120]}}])");
  EXPECT_ERROR(read_segments(masks.path(), "", scene_info()), "labels.image.size", "rgb_0.json");
  masks.write("rgb_0.json", R"([{"segmentation": [[1, 2]]}])");
  EXPECT_ERROR(read_segments(masks.path(), "", scene_info()), "labels.shape.points", "mask 1");
  masks.write("rgb_0.json", R"({"annotations": [{"area": 3}]})");
  EXPECT_ERROR(read_segments(masks.path(), "", scene_info()), "labels.file.format", "mask 1", "segmentation");
  const std::string coco =
      dir.write("c.json", R"({"images": [], "annotations": [{"image_id": 7, "segmentation": []}]})");
  EXPECT_ERROR(read_segments(coco, "", scene_info()), "labels.annotation.reference", "annotation 1", "7");
  EXPECT_ERROR(read_segments(dir.path(), "{nome}.png", scene_info()), "labels.pattern.invalid", "nome");
}

}  // namespace
}  // namespace semfield
