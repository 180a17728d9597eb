// Labels out and in again: regions traced exactly, files read back by the project and by a Python script of its own.
#include <algorithm>

#include "core/rng.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "labels/label_export.h"
#include "labels/mask_outlines.h"
#include "scene/classes/class_import.h"
#include "scene/classes/class_table.h"
#include "system/files.h"
#include "tests/labels/reader_case.h"
#include "tests/program.h"

namespace semfield {
namespace {

using namespace testing_labels;
using namespace testing_room;

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

TEST(LabelExport, OwnReadersGiveTheSameMapBack) {
  const std::string folder = fresh_folder("t");
  const std::vector<LabelledFrame> frames{drawn("a/hard", kHard), noisy("noise", 61, 47, 0.7)};
  for (const CocoMasks masks : {CocoMasks::polygons, CocoMasks::run_lengths}) {
    CocoExport coco(room_table(), masks);
    for (const LabelledFrame& frame : frames) coco.add(frame);
    coco.write(folder + "/coco.json");
    auto reader = make_reader("coco", "file: " + folder + "/coco.json");
    for (const ClassTable& known : {room_table(), ClassTable{}}) {
      EXPECT_EQ(read_labels(*reader, frame_of("a/hard"), known).hard, frames[0].label);
      EXPECT_EQ(read_labels(*reader, frame_of("noise"), known).hard, frames[1].label);
    }
  }
  const std::string labelme = fresh_folder("labelme");
  for (const LabelledFrame& frame : frames) EXPECT_GT(write_labelme(labelme, frame, room_table()), 10);
  auto reader = make_reader("labelme", "folder: " + labelme);
  EXPECT_EQ(read_labels(*reader, frame_of("a/hard"), room_table()).hard, frames[0].label);
  EXPECT_EQ(read_labels(*reader, frame_of("noise"), room_table()).hard, frames[1].label);
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
  EXPECT_EQ(error_of([&] { coco.add(second); }),
            "frame 'right_0001': another image of the file is called 'right_0001'; give the frame another name");
}

// `semfield export` and `semfield classes`: the program on a tiny room; what it wrote is compared with what it renders.

using namespace testing_program;

// Two cameras whose images have one name: readers find their frames by the folders.
TEST(ExportVerb, ImagesOfOneNameAreCalledWithTheirFolders) {
  const std::string folder = fresh_folder("rig"), room = folder + "/room";
  std::string frames;
  for (const std::string side : {"left", "right"}) {
    std::filesystem::create_directories(room + "/" + side);
    write_png_rgb(room + "/" + side + "/0001.png", 8, 6, std::vector<std::uint8_t>(144, 90));
    frames += (frames.empty() ? "{" : ", {") + std::string("\"file_path\": \"") + side +
              "/0001.png\", \"depth_path\": \"depth.png\", \"label_path\": \"label.png\", \"transform_matrix\": "
              "[[1,0,0," +
              (side == "left" ? "0" : "1") + "],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}";
  }
  write_png_gray16(room + "/depth.png", 8, 6, std::vector<std::uint16_t>(48, 1500));
  write_png_gray8(room + "/label.png", 8, 6, std::vector<std::uint8_t>(48, 1));
  write_file_atomic(room + "/classes.yaml", std::string_view("- {id: 0, name: void, ignore: true}\n"
                                                             "- {id: 1, name: wall}\n- {id: 2, name: chair}\n"));
  write_file_atomic(room + "/transforms.json", "{\"fl_x\": 8, \"depth_unit_m\": 0.001, \"frames\": [" + frames + "]}");
  write_file_atomic(folder + "/room.yaml",
                    std::string_view("scene: {type: transforms_json, root: room, test_every: 0}\n"
                                     "passes:\n  - name: main\n    sampler: {type: stratified, samples: 8}\n"
                                     "    position: {type: frequency, frequencies: 2}\n"
                                     "    field: {type: nerf_mlp, depth: 2, width: 16, skip_at: 0}\n"
                                     "train: {steps: 2, rays: 8}\n"));
  const Result trained = semfield_run("train room.yaml --threads 1 --out run -q", folder);
  ASSERT_EQ(trained.code, 0) << trained.err;
  const Result r = semfield_run("export run --split train --format coco --out coco.json", folder);
  ASSERT_EQ(r.code, 0) << r.err;
  EXPECT_HAS(read_text_file(folder + "/coco.json"), "\"file_name\":\"left/0001.png\"",
             "\"file_name\":\"right/0001.png\"");
}

TEST(ExportVerb, EveryFormHoldsTheRenderedLabels) {
  const std::string folder = fresh_folder("t");
  testing_room::write_replica(folder + "/room", 5);
  // Labels by way of a reader: the class images under another name.
  std::filesystem::rename(folder + "/room/semantic_class", folder + "/predictions");
  write_file_atomic(
      folder + "/room.yaml",
      "include: " + std::string(SEMFIELD_SOURCE_DIR) +
          "/configs/presets/room.yaml\n"
          "scene: {type: replica, root: room, train_step: 2, test_step: 2, test_offset: 1, labels: {from: "
          "{type: images, folder: predictions, pattern: 'semantic_class_{number}.png'}}}\n");
  const Result trained = semfield_run("train room.yaml --steps 20 --threads 1 --out run -q", folder);
  ASSERT_EQ(trained.code, 0) << trained.err;
  const Result render = semfield_run("render run --split test --out rendered -q", folder);
  ASSERT_EQ(render.code, 0) << render.err;
  const ClassTable table = ClassTable::load(folder + "/room/classes.yaml");
  for (const std::string format : {"coco", "coco_rle", "labelme"}) {
    const Result r = semfield_run("export run --split test --format " + format + " --out " + format + ".json", folder);
    ASSERT_EQ(r.code, 0) << r.err;
    EXPECT_EQ(r.out.find("export: frames=2 shapes="), 0u) << r.out;
    const std::string path = folder + "/" + format + ".json";
    const auto reader =
        format == "labelme" ? make_reader("labelme", "folder: " + path) : make_reader("coco", "file: " + path);
    for (const std::string name : {"rgb_1", "rgb_3"}) {
      const Image<std::uint16_t> ids = read_ids(folder + "/rendered/" + name + "_label.png");
      std::vector<std::int16_t> rendered;
      for (const std::uint16_t id : ids.pixels) rendered.push_back(static_cast<std::int16_t>(table.index_of(id)));
      EXPECT_EQ(read_labels(*reader, frame_of(name), table).hard, rendered) << format << " " << name;
    }
  }
  // A run that loads its images smaller: labels still have the size of the images, unless an option says otherwise.
  const std::string half = "export run --split test --set scene.load.downscale=2 ";
  for (const std::string size : {"stored", "trained"}) {
    const Result r = semfield_run(half + "--size " + size + " --out half.json", folder);
    ASSERT_EQ(r.code, 0) << r.err;
    const std::string json = read_text_file(folder + "/half.json");
    EXPECT_HAS(json, size == "stored" ? R"("height":30,"id":1,"width":40)" : R"("height":15,"id":1,"width":20)")
        << json.substr(0, 200);
  }
  ASSERT_EQ(semfield_run(half + "--format png --out images", folder).code, 0);
  EXPECT_EQ(read_text_file(folder + "/images/classes.yaml"), table.to_yaml());
  for (const std::string name : {"rgb_1", "rgb_3"}) {
    const Image<std::uint16_t> ids = read_ids(folder + "/images/" + name + "_label.png"),
                               whole = read_ids(folder + "/rendered/" + name + "_label.png");
    ASSERT_EQ(ids.width_px, 40);
    ASSERT_EQ(ids.height_px, 30);
    int alike = 0;
    for (std::size_t i = 0; i < ids.pixels.size(); ++i) alike += ids.pixels[i] == whole.pixels[i];
    EXPECT_GT(alike, 40 * 30 * 8 / 10) << name << ": rendered at every second pixel, and brought to the others";
  }
  // No region of the exported labels is smaller than asked; large ones are tested in small_regions_test.cpp.
  const Result calm = semfield_run("export run --split test --min-area 30 --format coco --out calm.json", folder);
  ASSERT_EQ(calm.code, 0) << calm.err;
  EXPECT_HAS(calm.err, " regions of fewer than 30 pixels took the class around them: ");
  const auto coco = make_reader("coco", "file: " + folder + "/calm.json");
  for (const std::string name : {"rgb_1", "rgb_3"}) {
    const std::vector<std::int16_t> labels = read_labels(*coco, frame_of(name), table).hard;
    std::int64_t smallest = std::ssize(labels);
    for (const MaskRegion& region : mask_regions(labels, 40, 30)) smallest = std::min(smallest, region.area_px);
    EXPECT_GE(smallest, 30) << name;
  }
  EXPECT_EQ(semfield_run("export run --min-area -1 --out x.json", folder).err,
            "semfield: --min-area -1: expected 0 to 1000000000 [usage.value.invalid]\n");
  const Result wrong = semfield_run("export run --format coc --out x.json", folder);
  EXPECT_EQ(wrong.code, 2);
  EXPECT_EQ(
      wrong.err,
      "semfield: --format coc: expected coco, coco_rle, labelme or png; did you mean coco? [usage.value.invalid]\n");
  EXPECT_EQ(semfield_run("export none --out x.json", folder).code, 66);
}

TEST(ClassesVerb, ConvertsTables) {
  const std::string folder = fresh_folder("t");
  EXPECT_EQ(semfield_run("classes nyu40", folder).out, published_classes("nyu40").to_yaml());
  ASSERT_EQ(semfield_run("classes scannet20 --format cvat --out labelmap.txt", folder).code, 0);
  EXPECT_EQ(load_cvat_labelmap(folder + "/labelmap.txt").valid_count(), 20);
  EXPECT_EQ(semfield_run("classes labelmap.txt --format csv", folder).out.find("class_id,class\n0,void\n1,wall\n"), 0u);
  EXPECT_NE(semfield_run("classes nyu13 --colors semfield", folder).out, published_classes("nyu13").to_yaml());
  write_file_atomic(folder + "/l.tsv", std::string_view("id\traw_category\tnyu40id\n2\toffice chair\t5\n"));
  EXPECT_HAS(semfield_run("classes l.tsv --ids nyu40", folder).out, "{id: 5, name: \"chair\"");
  EXPECT_HAS(semfield_run("classes l.tsv", folder).out, "{id: 2, name: \"office chair\"");
  const Result wrong = semfield_run("classes nyu13 --ids nyu40", folder);
  EXPECT_EQ(wrong.code, 2);
  EXPECT_SAID(wrong.err, "usage.flag.conflict", "semfield: --ids nyu40", "'nyu13'", "scannetv2-labels.combined.tsv");
  EXPECT_EQ(semfield_run("classes nyu13 --format yml", folder).err,
            "semfield: --format yml: expected yaml, csv or cvat; did you mean yaml? [usage.value.invalid]\n");
  EXPECT_EQ(semfield_run("classes none.yaml", folder).code, 66);
}

}  // namespace
}  // namespace semfield
