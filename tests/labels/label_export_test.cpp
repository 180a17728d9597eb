// PNG files that viewers turn by an EXIF orientation.

#include "labels/label_export.h"

#include <algorithm>
#include <cstdlib>

#include "core/files.h"
#include "core/rng.h"
#include "formats/image_io.h"
#include "labels/mask_outlines.h"
#include "labels/training_labels.h"
#include "scene/classes/class_table.h"
#include "scene/loading/frame_files.h"
#include "scene/loading/posed_photographs.h"
#include "scene/scene.h"
#include "tests/labels/reader_case.h"
#include "tests/says.h"
#include "tests/scene/image_bytes.h"
#include "tests/scene/npz_files.h"

namespace semfield {
namespace {

using namespace testing_labels;
using namespace testing_room;

/// Adds the chunk eXIf to a PNG, before its last chunk.
inline void set_orientation(const std::string& path, int orientation) {
  const std::string file = read_text_file(path);
  std::vector<std::uint8_t> bytes(file.begin(), file.end() - 12);
  const auto value = static_cast<std::uint8_t>(orientation);
  testing_room::put_chunk(bytes, "eXIf", {'M', 'M', 0, 42, 0, 0, 0, 8, 0, 1, 1, 18, 0, 3, 0, 0, 0, 1, 0, value, 0, 0});
  testing_room::put_chunk(bytes, "IEND", {});
  write_file_atomic(path, std::string(bytes.begin(), bytes.end()));
}

/// As [Exif 2.3] has it, by hand: the stored pixel (x, y) that viewers show top left and top right, of a picture stored
/// as w x h pixels.
struct ShownCorners {
  int left_x, left_y, right_x, right_y;
};
inline ShownCorners shown_corners(int orientation, int w, int h) {
  const int r = w - 1, b = h - 1;
  const ShownCorners all[8] = {{0, 0, r, 0}, {r, 0, 0, 0}, {r, b, 0, b}, {0, b, r, b},
                               {0, 0, 0, b}, {0, b, 0, 0}, {r, b, r, 0}, {r, 0, r, b}};
  return all[orientation - 1];
}

// Labels out and in again: regions traced exactly, files read back by the project and by a Python script of its own.

LabelledFrame drawn(const std::string& name, const Rows& rows) {
  LabelledFrame frame{name, "", static_cast<std::int32_t>(rows[0].size()), static_cast<std::int32_t>(rows.size()), {}};
  for (const std::string& row : rows) {
    for (const char c : row) frame.label.push_back(c == '.' ? kVoid : static_cast<std::int16_t>(c - '0'));
  }
  return frame;
}

// Holes in holes, holes that touch at corners, regions that touch at corners, the whole border.
const Rows kHard{
    "0000000000002", "0111110101002", "0100010010102", "0102010101012", "0100010000002",
    "0111111111100", "0000000000100", "1111.11110101", "1000.00010111", "1011111010000",
    "1010.01010121", "1010101010111", "1111111111110",
};

LabelledFrame noisy(const std::string& name, std::int32_t width, std::int32_t height, double order) {
  LabelledFrame frame{name, "", width, height, std::vector<std::int16_t>(static_cast<std::size_t>(width * height))};
  const RandomAddress address{7, static_cast<std::uint64_t>(width), stream_id("test")};
  for (std::size_t i = 0; i < frame.label.size(); ++i) {
    // Blocks of classes 0..2 and void, sprinkled with single pixels.
    const std::size_t x = i % static_cast<std::size_t>(width), y = i / static_cast<std::size_t>(width);
    const std::uint64_t block = uniform_below(address, 1000000 + x / 7 * 1000 + y / 5, 4);
    const bool noise = static_cast<double>(uniform_below(address, 2 * i, 1000)) >= order * 1000;
    frame.label[i] = static_cast<std::int16_t>(noise ? uniform_below(address, 2 * i + 1, 4) : block) - std::int16_t{1};
  }
  return frame;
}

void expect_regions_give_the_map_back(const LabelledFrame& frame) {
  LabelRaster even_odd = void_raster(frame.width_px, frame.height_px);
  std::vector<int> winding(frame.label.size());
  std::int64_t area = 0;
  for (const MaskRegion& region : mask_regions(frame.label, frame.width_px, frame.height_px)) {
    const std::vector<PixelRun> runs = outline_runs(region.outline, frame.width_px, frame.height_px);
    EXPECT_EQ(area_of(runs), region.area_px);
    area += region.area_px;
    paint(runs, region.index, even_odd);
    // The sum of signed crossings to the right of each centre: 1 inside a clockwise outline, for the non-zero rule.
    for (std::size_t i = 0; i < region.outline.size(); ++i) {
      const PixelPoint a = region.outline[i], b = region.outline[(i + 1) % region.outline.size()];
      ASSERT_TRUE((a.x == b.x) != (a.y == b.y)) << "an edge that is no edge of pixels";
      for (auto y = static_cast<std::int32_t>(std::min(a.y, b.y)); y < std::max(a.y, b.y) && a.x == b.x; ++y) {
        for (std::int32_t x = 0; x < a.x; ++x) winding[y * frame.width_px + x] += a.y < b.y ? 1 : -1;
      }
    }
  }
  EXPECT_EQ(even_odd.hard, frame.label);
  std::int64_t labelled = 0;
  for (std::size_t i = 0; i < frame.label.size(); ++i) {
    labelled += frame.label[i] >= 0;
    ASSERT_EQ(winding[i], frame.label[i] >= 0 ? 1 : 0) << i;
  }
  EXPECT_EQ(area, labelled);
}

TEST(MaskOutlines, GiveTheSamePixelsBack) {
  expect_regions_give_the_map_back(drawn("a", kHard));
  for (const double order : {0.0, 0.5, 0.9, 1.0}) {
    expect_regions_give_the_map_back(noisy("a", 61, 47, order));
    expect_regions_give_the_map_back(noisy("a", 1, 40, order));
    expect_regions_give_the_map_back(noisy("a", 40, 1, order));
  }
  EXPECT_TRUE(mask_regions(std::vector<std::int16_t>(6, kVoid), 3, 2).empty());
}

TEST(MaskOutlines, OneRegionAConnectedAreaWithCornersOnly) {
  const LabelledFrame ring = drawn("a", {"0000", "0110", "0000"});
  const std::vector<MaskRegion> regions = mask_regions(ring.label, 4, 3);
  ASSERT_EQ(regions.size(), 2u);
  EXPECT_EQ(regions[0].outline.size(), 4u + 4 + 2) << "two rectangles, and the cut's ends";
  EXPECT_EQ(regions[1].outline.size(), 4u);
  const LabelledFrame diagonal = drawn("a", {"0.", ".0"});
  EXPECT_EQ(mask_regions(diagonal.label, 2, 2).size(), 2u);
}

TEST(LabelExport, ClassesThatWaitForTheirNamesAreNoCategories) {
  const std::string folder = fresh_folder("t");
  CocoExport coco(ClassTable({{1, "wall", {}, false}, {2, unnamed_class(2), {}, false}, {3, "cup", {}, false}}),
                  CocoMasks::polygons);
  LabelledFrame frame{"a", "", 2, 2, {0, 0, 2, 2}};
  coco.add(frame);
  coco.write(folder + "/coco.json");
  const std::string json = read_text_file(folder + "/coco.json");
  EXPECT_LACKS(json, "unnamed");
  EXPECT_HAS(json, "\"cup\"");
  EXPECT_EQ(named_classes(ClassTable({{1, "wall", {}, false}, {2, unnamed_class(2), {}, false}})).entries().size(), 1u);
}

bool has_python() { return std::system("python3 -c 'import json' >/dev/null 2>&1") == 0; }

// What the script prints: the size, then the class of every pixel.
std::vector<std::string> decoded(const std::string& kind, const std::string& file, const std::string& image) {
  const std::string command = "python3 " + shell_word(SEMFIELD_SOURCE_DIR "/tests/labels/decode_export.py") + " " +
                              kind + " " + shell_word(file) + " " + shell_word(image) + " 2>&1";
  std::vector<std::string> lines;
  FILE* pipe = ::popen(command.c_str(), "r");
  char line[256];
  while (pipe != nullptr && std::fgets(line, sizeof line, pipe) != nullptr) {
    lines.emplace_back(line);
    if (!lines.back().empty() && lines.back().back() == '\n') lines.back().pop_back();
  }
  EXPECT_EQ(::pclose(pipe), 0) << (lines.empty() ? "" : lines.back());
  return lines;
}

std::vector<std::string> wanted(const LabelledFrame& frame, bool with_id) {
  const ClassTable table = room_table();
  std::vector<std::string> lines{std::to_string(frame.width_px) + " " + std::to_string(frame.height_px)};
  for (const std::int16_t c : frame.label) {
    const std::string id = c < 0 || !with_id ? "" : std::to_string(table.valid(c).id) + ":";
    lines.push_back(c < 0 ? "-" : id + table.valid(c).name);
  }
  return lines;
}

TEST(LabelExport, AnotherReaderGivesTheSameMapBack) {
  if (!has_python()) GTEST_SKIP() << "python3 is not at hand";
  const std::string folder = fresh_folder("t");
  LabelledFrame first = drawn("hard", kHard), second = noisy("noise", 61, 47, 0.7);
  second.image_path = folder + "/images/noise_17.jpg";
  for (const CocoMasks masks : {CocoMasks::polygons, CocoMasks::run_lengths}) {
    CocoExport coco(room_table(), masks);
    coco.add(first);
    coco.add(second);
    EXPECT_GT(coco.annotations(), 5);
    coco.write(folder + "/coco.json");
    EXPECT_EQ(decoded("coco", folder + "/coco.json", "hard.png"), wanted(first, true));
    EXPECT_EQ(decoded("coco", folder + "/coco.json", "noise_17.jpg"), wanted(second, true));
  }
  write_labelme(folder, first, room_table());
  write_labelme(folder, second, room_table());
  EXPECT_EQ(decoded("labelme", folder + "/hard.json", "hard.png"), wanted(first, false));
  EXPECT_EQ(decoded("labelme", folder + "/noise.json", "images/noise_17.jpg"), wanted(second, false));
}

// Readers know an image by its file's stem.
TEST(LabelExport, ImagesOfOneNameInTwoFoldersStayTwo) {
  const std::string path = fresh_folder("alike") + "/coco.json";
  LabelledFrame first = drawn("0001", kHard), second = drawn("right_0001", kHard), third = drawn("left/0001", kHard);
  first.image_path = "/room/front/0001.jpg";
  second.image_path = "/room/right/0001.jpg";
  third.image_path = "/room/left/0001.jpg";
  CocoExport coco(room_table(), CocoMasks::polygons);
  for (const LabelledFrame& frame : {first, second, third}) coco.add(frame);
  coco.write(path);
  const std::string text = read_text_file(path);
  for (const char* name : {"0001.jpg", "right_0001.jpg", "left_0001.jpg"})
    EXPECT_HAS(text, "\"file_name\":\"" + std::string(name) + "\"") << name;
  EXPECT_HAS(error_of([&] { coco.add(second); }), "right_0001", "is called");
}

// Labels are drawn over pictures as viewers show them, of every EXIF orientation. Every reader: export_verb_test.py.

using testing_room::fresh_folder;

// A frame stored as w x h pixels, and its labels as shown: chair top left, table top right, the rest wall.
struct TurnedCase {
  int w, h, orientation;
  std::string folder;
  LoadedScene scene;

  TurnedCase(int width, int height, int turned, int divide = 1)
      : w(width), h(height), orientation(turned), folder(fresh_folder("t")) {
    const std::string image = folder + "/images/a.png";
    fs::create_directories(folder + "/images");
    write_png_rgb(image, w, h, std::vector<std::uint8_t>(static_cast<std::size_t>(3 * w * h), 99));
    set_orientation(image, orientation);
    FrameInfo frame{.name = "a", .source = image, .camera = {.width_px = w / divide, .height_px = h / divide}};
    frame.orientation = image_size(image).orientation;
    EXPECT_EQ(frame.orientation, orientation);
    scene.info.frames = {frame};
    scene.info.classes = room_table();
    scene.frames.resize(1);
    scene.class_pixels.resize(1);
  }
  int shown_w() const { return orientation >= 5 ? h : w; }
  int shown_h() const { return orientation >= 5 ? w : h; }
  std::vector<std::uint8_t> shown_ids() const {
    std::vector<std::uint8_t> ids(static_cast<std::size_t>(w * h), 1);
    ids[0] = 4;
    ids[static_cast<std::size_t>(shown_w() - 1)] = 7;
    return ids;
  }

  // Labels of the loaded frame, its pixels as stored.
  Rows read(const std::string& type, const std::string& yaml) {
    LabelConfig config;
    config.from = {type, make_reader(type, yaml)};
    Diagnostics found;
    open_label_files(scene, config, found);
    const TrainingLabels labels = make_training_labels(scene, config, found);
    for (const Diagnostic& d : found.all())
      if (d.severity != Severity::note) ADD_FAILURE() << d.text();
    const Camera& camera = scene.info.frames[0].camera;
    LabelRaster raster{camera.width_px, camera.height_px, {}, {}};
    for (std::size_t p = 0; p < labels.frames.at(0).size(); ++p) raster.hard.push_back(labels.frames[0][p]);
    return rows_of(raster);
  }
  Rows wanted() const {
    Rows rows(static_cast<std::size_t>(h), std::string(static_cast<std::size_t>(w), '0'));
    const ShownCorners at = shown_corners(orientation, w, h);
    rows[static_cast<std::size_t>(at.left_y)][static_cast<std::size_t>(at.left_x)] = '1';
    rows[static_cast<std::size_t>(at.right_y)][static_cast<std::size_t>(at.right_x)] = '2';
    return rows;
  }
};

// Loaded at half the size, in the quarter that is shown top left.
TEST(TurnedPictures, AreScaledAsTheyAreStored) {
  for (int orientation = 1; orientation <= 8; ++orientation) {
    TurnedCase c(8, 4, orientation, 2);
    const int across = c.shown_w(), down = c.shown_h();
    std::vector<std::uint8_t> ids(32, 1);
    for (int y = 0; y < down / 2; ++y)
      for (int x = 0; x < across / 2; ++x) ids[static_cast<std::size_t>(y * across + x)] = 4;
    fs::create_directories(c.folder + "/ids");
    write_png_gray8(c.folder + "/ids/a.png", across, down, ids);
    const ShownCorners at = shown_corners(orientation, 4, 2);
    Rows wanted(2, "0000");
    const std::size_t half = at.left_x == 0 ? 0 : 2;
    wanted[static_cast<std::size_t>(at.left_y)][half] = wanted[static_cast<std::size_t>(at.left_y)][half + 1] = '1';
    EXPECT_EQ(c.read("images", "folder: " + c.folder + "/ids"), wanted) << orientation;
  }
}

TEST(TurnedPictures, LabelsOfTheStoredPixelsAreRefusedWithTheRemedy) {
  TurnedCase c(5, 3, 6);
  fs::create_directories(c.folder + "/ids");
  write_png_gray8(c.folder + "/ids/a.png", 5, 3, c.shown_ids());
  LabelConfig config;
  config.from = {"images", make_reader("images", "folder: " + c.folder + "/ids")};
  Diagnostics found;
  open_label_files(c.scene, config, found);
  const std::string said = error_of([&] { (void)make_training_labels(c.scene, config, found); });
  EXPECT_HAS(said, "labels are 5 x 3 pixels, the frame is 3 x 5");
  EXPECT_HAS(said, "as shown, by its EXIF orientation 6");
  EXPECT_HAS(said, "exiftool -Orientation=");
}

// The scene's own label and instance images, which a person or a tool has drawn too.
TEST(TurnedPictures, LabelImagesOfTheSceneAreReadAsShown) {
  for (int orientation = 1; orientation <= 8; ++orientation) {
    TurnedCase c(5, 3, orientation);
    const std::string label = c.folder + "/label.png";
    const std::vector<std::uint8_t> ids = c.shown_ids();
    write_png_gray8(label, c.shown_w(), c.shown_h(), ids);
    const FrameFiles files{c.scene.info.frames[0].source, "", label, label};
    FrameInfo frame = c.scene.info.frames[0];
    frame.orientation = 1;
    Diagnostics found;
    FrameFileCheck check(MissingFiles::error);
    check.check_headers(frame, files, {}, found);
    for (const Diagnostic& d : found.all()) ADD_FAILURE() << d.text();
    EXPECT_EQ(frame.orientation, orientation);
    FrameBuffer out;
    read_frame_files(frame, files, {}, room_table(), out);
    EXPECT_EQ(rows_of({5, 3, out.label, {}}), c.wanted()) << orientation;
    const ShownCorners at = shown_corners(orientation, 5, 3);
    EXPECT_EQ(out.instance[static_cast<std::size_t>(5 * at.left_y + at.left_x)], 4);
    EXPECT_EQ(out.instance[static_cast<std::size_t>(5 * at.right_y + at.right_x)], 7);
  }
}

// Speckles are given to what surrounds them, and nothing else changes; label files of real scenes.

TEST(SmallRegions, TakeTheClassAroundThem) {
  std::vector<std::int16_t> label =
      drawn("a",
            {
                "1111122222",
                "1311122.22",  // a speckle, and one of void
                "1111152222",  // between two classes, equally near: the one that comes first
                "1134112222",  // two speckles side by side
                "1111122222",
            })
          .label;
  const SmallRegions found = fill_small_regions(label, 10, 5, 3);
  EXPECT_EQ(label, drawn("a",
                         {
                             "1111122222",
                             "1111122222",
                             "1111122222",
                             "1111112222",
                             "1111122222",
                         })
                       .label);
  EXPECT_EQ(found.regions, 5);
  EXPECT_EQ(found.pixels, 5);
}

TEST(SmallRegions, ConnectionThroughCornersIsNone) {
  std::vector<std::int16_t> label = drawn("a", {"1000", "0100", "0010", "0000"}).label;
  EXPECT_EQ(fill_small_regions(label, 4, 4, 3).pixels, 3) << "three regions of a pixel each";
  EXPECT_EQ(label, std::vector<std::int16_t>(16, 0));
}

// Blocks of four classes under single pixels of noise: every region from the area on keeps each of its pixels, and none
// below it is left.
TEST(SmallRegions, NoRegionFromTheAreaOnChanges) {
  constexpr std::int32_t kWidth = 61, kHeight = 47;
  constexpr std::int64_t kArea = 12;
  const RandomAddress address{3, 0, stream_id("test")};
  std::vector<std::int16_t> label;
  for (std::int32_t y = 0; y < kHeight; ++y) {
    for (std::int32_t x = 0; x < kWidth; ++x) {
      const std::uint64_t pixel = static_cast<std::uint64_t>(y * kWidth + x);
      const bool noise = uniform_below(address, 2 * pixel, 100) < 25;
      const auto block = static_cast<std::uint64_t>(1000000 + x / 9 * 100 + y / 7);
      label.push_back(static_cast<std::int16_t>(uniform_below(address, noise ? 2 * pixel + 1 : block, 4)));
    }
  }
  const std::vector<std::int16_t> before = label;
  const SmallRegions found = fill_small_regions(label, kWidth, kHeight, kArea);
  std::int64_t small = 0, large = 0;
  for (const MaskRegion& region : mask_regions(before, kWidth, kHeight)) {
    if (region.area_px < kArea) {
      ++small;
      continue;
    }
    ++large;
    for (const PixelRun& run : outline_runs(region.outline, kWidth, kHeight)) {
      for (std::int32_t x = run.x0; x < run.x1; ++x)
        ASSERT_EQ(label[run.y * kWidth + x], region.index) << x << " " << run.y;
    }
  }
  EXPECT_EQ(found.regions, small);
  EXPECT_GT(small, 100);
  EXPECT_GT(large, 10);
  for (const MaskRegion& region : mask_regions(label, kWidth, kHeight)) EXPECT_GE(region.area_px, kArea);
}

}  // namespace
}  // namespace semfield
