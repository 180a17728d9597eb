// Class probabilities, outlines to pixels, label files to frames, labels that train. Label images, clicks, labelme and
// COCO: tests/bad_files/labels.cases.

#include <algorithm>
#include <set>

#include "formats/image_io.h"
#include "labels/frame_match.h"
#include "labels/mask_outlines.h"
#include "labels/training_labels.h"
#include "tests/labels/reader_case.h"
#include "tests/scene/npz_files.h"

namespace semfield {
namespace {

using namespace testing_labels;
using testing_room::fresh_folder;

// --- class probabilities ---

struct NpzCase {
  std::string folder = fresh_folder("t");
  NpzCase() { classes(R"(["table", "other", "wall"])"); }
  void classes(const std::string& text) const { write_file_atomic(folder + "/classes.json", text); }
  // 1 x 2 pixels.
  void write(const std::vector<float>& values, std::int64_t columns = 3) const {
    const NpzEntry entry{"probability", {1, 2, columns}, values};
    const std::vector<float> confidence{1.0F, 0.5F};
    const NpzEntry second{"confidence", {1, 2}, confidence};
    const std::vector<NpzEntry> entries{entry, second};
    write_npz(folder + "/a.npz", entries);
  }
  std::unique_ptr<LabelReader> reader(const std::string& rest = "") const {
    return make_reader("npz", "folder: " + folder + "\n" + rest);
  }
  std::string read_error(const std::string& rest = "") const {
    auto r = reader(rest);
    Diagnostics d;
    const ClassTable table = open_for(*r, room_table(), {frame_of("a", 4, 2)}, d);
    for (const Diagnostic& x : d.all()) ADD_FAILURE() << x.text();
    return error_of([&] { (void)r->read(frame_of("a", 4, 2), table); });
  }
};

TEST(NpzLabels, ColumnsGoToTheirClasses) {
  const NpzCase c;
  c.write({0.5F, 0.25F, 0.25F, 0, 0, 0});
  const LabelRaster raster = read_labels(*c.reader(), frame_of("a", 4, 2), room_table());
  EXPECT_EQ(raster.width_px, 2);
  EXPECT_EQ(raster.height_px, 1);
  EXPECT_TRUE(raster.hard.empty());
  EXPECT_EQ(raster.soft, (std::vector<float>{0.25F, 0, 0.5F, 0, 0, 0}));
  for (const char* order : {R"({"table": 0, "other": 1, "wall": 2})", R"({"0": "table", "1": "other", "2": "wall"})"}) {
    c.classes(order);
    EXPECT_EQ(read_labels(*c.reader(), frame_of("a", 4, 2), room_table()).soft, raster.soft) << order;
  }
  c.write({0.5F, 0.25F, 0.25F, 0, 0, 1});
  EXPECT_EQ(read_labels(*c.reader("confidence_key: confidence"), frame_of("a", 4, 2), room_table()).soft,
            (std::vector<float>{0.25F, 0, 0.5F, 0.5F, 0, 0}));
  // Without a table of the scene: names in the order of the file; "other" is void.
  Diagnostics d;
  const auto reader = c.reader();
  const ClassTable table = open_for(*reader, {}, {frame_of("a", 4, 2)}, d);
  ASSERT_EQ(table.valid_count(), 2);
  EXPECT_EQ(table.valid(0).name, "table");
  EXPECT_EQ(reader->read(frame_of("a", 4, 2), table).soft, (std::vector<float>{0.5F, 0.25F, 0, 1}));
  EXPECT_FALSE(reader->has(frame_of("b", 4, 2)));
}

// Values and shapes that are wrong: tests/bad_files/labels.cases.
TEST(NpzLabels, AnArrayThatIsNotThereIsNamed) {
  const NpzCase c;
  const std::string file = "'" + c.folder + "/a.npz'";
  c.write({0.5F, 0.25F, 0.25F, 0, 0, 0});
  EXPECT_HAS(c.read_error("key: logits"), file, "'logits'", "probability, confidence");
  EXPECT_HAS(c.read_error("key: confidence"), file + ", entry 'confidence'", "(1, 2)");
  EXPECT_HAS(c.read_error("confidence_key: probability"), file, "entry 'probability'", "(1, 2, 3)");
}

// --- filling ---

// By hand: tests/bad_files/labels.cases.
Rows filled(const Outline& outline, int width, int height) {
  LabelRaster raster = void_raster(width, height);
  paint(outline_runs(outline, width, height), 1, raster);
  return rows_of(raster);
}

TEST(OutlineFill, ThePixelCentreDecides) {
  EXPECT_EQ(filled({{0.6, 0.6}, {3.4, 0.6}, {3.4, 2.4}, {0.6, 2.4}}, 4, 3), (Rows{"....", ".11.", "...."}));
  EXPECT_EQ(filled({{0.4, 0.4}, {2.6, 0.4}, {2.6, 1.6}, {0.4, 1.6}}, 4, 3), (Rows{"111.", "111.", "...."}));
  // A triangle: centres (x + .5, y + .5) with x + y + 1 < 4.
  EXPECT_EQ(filled({{0, 0}, {4, 0}, {0, 4}}, 4, 4), (Rows{"111.", "11..", "1...", "...."}));
  EXPECT_EQ(filled({{0, 0}, {4, 0}, {0, 2}}, 4, 2), (Rows{"111.", "1..."})) << "the edge counts at the centre's height";
}

TEST(OutlineFill, EvenOddAndPartsOutsideTheImage) {
  // An outline that winds twice around the middle leaves it out.
  EXPECT_EQ(filled({{0, 0}, {5, 0}, {5, 5}, {0, 5}, {0, 0}, {1, 1}, {4, 1}, {4, 4}, {1, 4}, {1, 1}}, 5, 5),
            (Rows{"11111", "1...1", "1...1", "1...1", "11111"}));
  EXPECT_EQ(filled({{-1e6, -1e6}, {1e6, -1e6}, {1e6, 1e6}, {-1e6, 1e6}}, 3, 2), (Rows{"111", "111"}));
  EXPECT_EQ(filled({{10, 10}, {20, 10}, {20, 20}}, 3, 2), (Rows{"...", "..."}));
  EXPECT_TRUE(outline_runs({}, 3, 2).empty());
  LabelRaster disc = void_raster(5, 5);
  paint(disc_runs({2.5, 2.5}, 1.0, 5, 5), 1, disc);
  EXPECT_EQ(rows_of(disc), (Rows{".....", "..1..", ".111.", "..1..", "....."}));
  EXPECT_TRUE(disc_runs({-9, 2}, 1, 5, 5).empty());
}

TEST(OutlineFill, NeighboursShareNoPixelAndLeaveNoneOut) {
  // A fan of triangles around a point that is a pixel centre, its corners on pixel centres too.
  const std::vector<PixelPoint> rim{{0.5, 0.5}, {4.5, 0.5}, {8.5, 0.5}, {8.5, 4.5},
                                    {8.5, 8.5}, {4.5, 8.5}, {0.5, 8.5}, {0.5, 4.5}};
  std::vector<int> count(9 * 9);
  for (std::size_t i = 0; i < rim.size(); ++i) {
    for (const PixelRun& run : outline_runs({{4.5, 4.5}, rim[i], rim[(i + 1) % rim.size()]}, 9, 9)) {
      for (int x = run.x0; x < run.x1; ++x) ++count[run.y * 9 + x];
    }
  }
  for (int y = 0; y < 9; ++y) {
    for (int x = 0; x < 9; ++x) EXPECT_EQ(count[y * 9 + x], x < 8 && y < 8 ? 1 : 0);
  }
}

TEST(OutlineFill, OfNothingIsNothing) {
  EXPECT_TRUE(outline_runs({}, 3, 2).empty());
  EXPECT_TRUE(disc_runs({-9, 2}, 1, 5, 5).empty());
}

// --- COCO ---

TEST(Coco, RunLengthTextRoundTrips) {
  for (const std::vector<std::int64_t>& counts : {std::vector<std::int64_t>{0, 12},
                                                  {4, 2, 3, 1, 2},
                                                  {1, 1, 1, 1, 1, 1},
                                                  {1000000, 1, 5, 70000, 0, 3, 16, 31, 32, 1024, 15}}) {
    EXPECT_EQ(counts_of_text(text_of_counts(counts)), counts);
  }
  EXPECT_EQ(text_of_counts({4, 2, 3, 1, 2}), "423OO");
}

// Label files find the pictures that they are of. Of two cameras, with names of tools: tests/bad_files/labels.cases.

FrameInfo frame_at(const std::string& name, const std::string& source) {
  FrameInfo frame = frame_of(name);
  frame.source = source;
  return frame;
}

TEST(FrameMatch, AnotherNameDecidesWhereTheFirstDoesNot) {
  Diagnostics found;
  const std::vector<PictureName> pictures{{.path = "0001.png", .place = "a", .other = "right_0001.json"},
                                          {.path = "moved.png", .place = "b", .other = "left/0002.json"},
                                          {.path = "0001.png", .place = "c", .file = "/s/images/left/0001.png"}};
  const std::vector<FrameInfo> rig{
      frame_at("0001", "/s/images/left/0001.png"), frame_at("0002", "/s/images/left/0002.png"),
      frame_at("right_0001", "/s/images/right/0001.png"), frame_at("right_0002", "/s/images/right/0002.png")};
  EXPECT_EQ(match_frames(pictures, rig, "f", found),
            (std::map<std::string, std::size_t>{{"right_0001", 0}, {"0002", 1}, {"0001", 2}}));
  EXPECT_TRUE(found.all().empty());
}

TEST(FrameMatch, NamesOfExportsAreFoundAgain) {
  const std::string folder = fresh_folder("t");
  std::vector<FrameInfo> frames{frame_at("a b", "nothing")};
  for (const char* side : {"left", "right"}) {
    std::filesystem::create_directories(folder + "/" + side);
    for (const char* name : {"1", "2"}) {
      if (side[0] == 'l' && name[0] == '2') continue;
      const std::string path = folder + "/" + side + "/" + name + ".png";
      write_png_gray8(path, 1, 1, std::vector<std::uint8_t>(1));
      frames.push_back(frame_at(std::string(side) + name, path));
    }
  }
  const std::vector<std::string> names = picture_names(frames);
  EXPECT_EQ(names, (std::vector<std::string>{"a b.png", "left/1.png", "right/1.png", "2.png"}));
  std::vector<PictureName> pictures;
  for (const std::string& name : names) pictures.push_back({.path = name});
  Diagnostics found;
  EXPECT_EQ(match_frames(pictures, frames, "labels.json", found),
            (std::map<std::string, std::size_t>{{"a b", 0}, {"left1", 1}, {"right1", 2}, {"right2", 3}}));
}

// Which labels train: the scene's own or those of files, scaled, selected, degraded; the truth stays.

ClassTable two_classes() {
  return ClassTable({{0, "void", {}, true}, {4, "wall", {}, false}, {9, "chair", {}, false}});
}

// Frames a and b train, t tests; 4 x 2 pixels.
LoadedScene tiny_scene(bool with_labels) {
  LoadedScene scene;
  if (with_labels) scene.info.classes = two_classes();
  for (const char* name : {"a", "b", "t"}) {
    FrameInfo f{.name = name, .camera = {.width_px = 4, .height_px = 2}, .has_labels = with_labels};
    f.split = f.name == "t" ? Split::test : Split::train;
    scene.info.frames.push_back(f);
    FrameBuffer b{.width_px = 4, .height_px = 2};
    b.rgb.assign(24, 0);
    if (with_labels) b.label = {0, 0, 1, kVoid, 1, 1, 1, 1};
    scene.frames.emplace_back(b);
    scene.class_pixels.push_back(with_labels ? std::vector<std::int64_t>{2, 5, 1} : std::vector<std::int64_t>{});
  }
  return scene;
}

// 8 x 4 pixels, twice the frames' size: class 1 in the right half.
struct Files final : LabelReader {
  bool soft = false;
  void describe(ParamVisitor&) override {}
  ClassTable open(const ClassTable&, Diagnostics&) override { return two_classes(); }
  bool has(const FrameInfo& frame) const override { return frame.name != "a"; }
  LabelRaster read(const FrameInfo&, const ClassTable& classes) const override {
    LabelRaster out{8, 4, {}, {}};
    for (int i = 0; i < 32; ++i) {
      const int c = i % 8 < 4 ? 0 : 1;
      if (soft) {
        for (int k = 0; k < classes.valid_count(); ++k) out.soft.push_back(k == c ? 0.5F : 0.25F);
      } else {
        out.hard.push_back(static_cast<std::int16_t>(c));
      }
    }
    return out;
  }
};

struct VoidFirst final : Degradation {
  void describe(ParamVisitor&) override {}
  StepFacts apply(const LoadedScene&, std::uint64_t seed, LabelSet& labels) const override {
    for (FrameLabels& f : labels) {
      if (!f.hard.empty()) f.hard[0] = kVoid;
    }
    return {{"seed", std::to_string(seed)}};
  }
};

LabelConfig files_config(bool soft = false) {
  LabelConfig config;
  auto reader = std::make_unique<Files>();
  reader->soft = soft;
  config.from = {"files", std::move(reader)};
  return config;
}

TEST(TrainingLabels, SelectionAndDegradationLeaveTheTruthAlone) {
  const LoadedScene scene = tiny_scene(true);
  LabelConfig config{.selection = {.frames = "1", .seed = 7}};
  config.degrade.push_back({"void_first", std::make_unique<VoidFirst>()});
  Diagnostics d;
  const TrainingLabels labels = make_training_labels(scene, config, d);
  EXPECT_EQ(labels.frames[0][0], kVoid);
  EXPECT_EQ(labels.frames[0][1], 0);
  EXPECT_TRUE(labels.frames[1].empty());
  EXPECT_EQ(scene.frames[0].label[0], 0);
  ASSERT_EQ(labels.steps.size(), 1u);
  EXPECT_EQ(labels.steps[0].facts[0].second, "7");
  EXPECT_EQ(labels.class_pixels[0], (std::vector<std::int64_t>{1, 5, 2}));
}

TEST(TrainingLabels, ATypeNamedAgainDrawsAnew) {
  const LoadedScene scene = tiny_scene(true);
  LabelConfig config{.selection = {.seed = 7}};
  for (const char* type : {"void_first", "other", "void_first"})
    config.degrade.push_back({type, std::make_unique<VoidFirst>()});
  Diagnostics d;
  const TrainingLabels labels = make_training_labels(scene, config, d);
  EXPECT_EQ(labels.steps[0].facts[0].second, "7");
  EXPECT_EQ(labels.steps[1].facts[0].second, "7");
  EXPECT_EQ(labels.steps[2].facts[0].second, std::to_string(7 + (std::int64_t{1} << 53)));
}

TEST(TrainingLabels, FilesReplaceTrainingLabelsAndGiveTestFramesTheirTruth) {
  LoadedScene scene = tiny_scene(false);
  LabelConfig config = files_config();
  Diagnostics d;
  open_label_files(scene, config, d);
  EXPECT_EQ(scene.info.classes.valid_count(), 2);
  read_test_labels(scene, config, d);
  const TrainingLabels labels = make_training_labels(scene, config, d);
  EXPECT_FALSE(d.has_errors());
  EXPECT_TRUE(labels.frames[0].empty());
  const LabelMap halves(std::vector<std::int16_t>{0, 0, 1, 1, 0, 0, 1, 1});
  EXPECT_EQ(labels.frames[1].hard, halves);
  EXPECT_TRUE(labels.frames[2].empty());
  EXPECT_EQ(scene.frames[2].label, halves);
  EXPECT_TRUE(scene.info.frames[2].has_labels);
  // A scene with its own labels keeps them as the truth.
  LoadedScene own = tiny_scene(true);
  read_test_labels(own, config, d);
  EXPECT_EQ(own.frames[2].label[3], kVoid);
  EXPECT_EQ(make_training_labels(own, config, d).frames[1].hard, halves);
}

TEST(TrainingLabels, SoftFilesCountTheMostProbableClass) {
  LoadedScene scene = tiny_scene(true);
  const LabelConfig config = files_config(true);
  Diagnostics d;
  const TrainingLabels labels = make_training_labels(scene, config, d);
  EXPECT_TRUE(labels.soft);
  EXPECT_EQ(labels.frames[1][0], 0);
  EXPECT_EQ(labels.frames[1][3], 1);
  EXPECT_EQ(labels.frames[1].soft.at(0, 1), 0.25F);
  EXPECT_EQ(labels.class_pixels[1], (std::vector<std::int64_t>{4, 4, 0}));
}

TEST(SoftMap, HalvesAreNearestAndExact) {
  for (std::uint32_t h = 0; h < 0x10000u; ++h) {
    const float f = float_of_half(static_cast<std::uint16_t>(h));
    if (std::isnan(f)) continue;
    ASSERT_EQ(half_of(f), h);
  }
  EXPECT_EQ(half_of(65519.0F), 0x7BFF);
  EXPECT_EQ(half_of(65520.0F), 0x7C00);
  EXPECT_EQ(half_of(1.0F + 0x1p-11F), 0x3C00) << "a tie goes to the even half";
  EXPECT_EQ(half_of(1.0F + 3 * 0x1p-11F), 0x3C02);
  EXPECT_EQ(half_of(0x1.8p-25F), 1);  // subnormal
  EXPECT_TRUE(std::isnan(float_of_half(half_of(NAN))));
}

TEST(SoftMap, RefusesWhatIsNoProbability) {
  SoftMap map(2, 2);
  map.set_row(1, std::array<float, 2>{0.2F, 0.6F});
  EXPECT_EQ(map.argmax(0), kVoid);
  EXPECT_EQ(map.argmax(1), 1);
  EXPECT_THROW(map.set_row(0, std::array<float, 2>{-0.1F, 1}), Error);
  EXPECT_THROW(map.set_row(0, std::array<float, 2>{NAN, 1}), Error);
}

// Label selection: exact counts, spacing, determinism, refusals.

// 180 training frames 0, 5, ..., 895 and as many test frames, as in the paper.
SceneInfo paper_split() {
  SceneInfo info;
  for (int i = 0; i < 900; ++i) {
    if (i % 5 != 0 && i % 5 != 2) continue;
    FrameInfo f{
        .name = "rgb_" + std::to_string(i), .split = i % 5 == 0 ? Split::train : Split::test, .has_labels = true};
    info.frames.push_back(f);
  }
  return info;
}

TEST(LabelSelection, CountsAreExact) {
  for (const auto& [frames, count] :
       {std::pair{"all", 180}, {"none", 0}, {"10%", 18}, {"5%", 9}, {"0.1%", 1}, {"0%", 0}, {"100%", 180}, {"2", 2}})
    EXPECT_EQ(label_frame_count(frames, 180), count) << frames;
  EXPECT_EQ(label_frame_count("10%", 0), 0);
}

TEST(LabelSelection, EvenKeyFramesAreSpacedAndOnlyTrainingFrames) {
  const SceneInfo info = paper_split();
  LabelParams p{.frames = "10%"};
  const std::vector<int> keep = select_label_frames(info, p);
  ASSERT_EQ(keep.size(), 18u);
  for (std::size_t k = 0; k < keep.size(); ++k) EXPECT_EQ(info.frames[keep[k]].name, "rgb_" + std::to_string(50 * k));
}

TEST(LabelSelection, RandomIsSeededWithoutRepeats) {
  const SceneInfo info = paper_split();
  LabelParams p{.frames = "18", .mode = LabelMode::random};
  const std::vector<int> a = select_label_frames(info, p);
  EXPECT_EQ(a, select_label_frames(info, p));
  EXPECT_EQ(std::set<int>(a.begin(), a.end()).size(), 18u);
  for (const int i : a) EXPECT_EQ(info.frames[i].split, Split::train);
  p.seed = 2;
  EXPECT_NE(a, select_label_frames(info, p));
  p.seed = 1;
  p.frames = "40";
  const std::vector<int> larger = select_label_frames(info, p);
  for (const int i : a) EXPECT_TRUE(std::binary_search(larger.begin(), larger.end(), i));
}

TEST(LabelSelection, NamedFrames) {
  const SceneInfo info = paper_split();
  const LabelParams p{.mode = LabelMode::named, .names = {"rgb_100", "rgb_0", "rgb_100"}};
  const std::vector<int> keep = select_label_frames(info, p);
  ASSERT_EQ(keep.size(), 2u);
  EXPECT_EQ(info.frames[keep[1]].name, "rgb_100");
}

// Frame 0 shows classes 0 and 1, frame 1 class 2 alone, frame 2 classes 0, 1 and 3: 2 first, then 1.
TEST(LabelSelection, CoverageTakesTheFrameThatShowsMostNewClasses) {
  SceneInfo info;
  for (int i = 0; i < 4; ++i) {
    FrameInfo f{.split = i == 3 ? Split::test : Split::train, .has_labels = true};
    info.frames.push_back(f);
  }
  const std::vector<std::vector<std::int64_t>> pixels{
      {9, 9, 0, 0, 0}, {0, 0, 1, 0, 30}, {1, 1, 0, 1, 0}, {5, 5, 5, 5, 5}};
  LabelParams p{.frames = "1", .mode = LabelMode::coverage};
  EXPECT_EQ(select_label_frames(info, p, pixels), (std::vector<int>{2}));
  p.frames = "2";
  EXPECT_EQ(select_label_frames(info, p, pixels), (std::vector<int>{1, 2}));
  p.frames = "3";
  EXPECT_EQ(select_label_frames(info, p, pixels), (std::vector<int>{0, 1, 2}));
}

}  // namespace
}  // namespace semfield
