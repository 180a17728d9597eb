// `semfield objects` as a user runs it: files, figures, segments of a folder, refusals.
#include <fmt/format.h>

#include <filesystem>
#include <nlohmann/json.hpp>
#include <set>

#include "formats/image_io.h"
#include "loading/packed_scene.h"
#include "objects/object_edits.h"
#include "scene/scene.h"
#include "system/files.h"
#include "testkit/analytic_scene.h"
#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using testing_program::Result;

constexpr const char* kQuick = " --set objects.steps=150 --set objects.points=3000 --set objects.rays=20000 ";

Result semfield(const std::string& words, const TempDir& dir) {
  return testing_program::semfield_run(words, dir.path());
}

// A trained run of the packed analytic room, whose instances are its classes, and the same as a folder of images.
void make_run(const TempDir& dir, bool with_instances) {
  testkit::AnalyticSceneOptions options;
  options.with_depth = true;
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene(options);
  Diagnostics diagnostics;
  SceneInfo info = scene->open(diagnostics);
  for (FrameInfo& frame : info.frames) frame.has_instances = with_instances;
  fs::create_directories(dir / "segments");
  write_packed_scene(dir / "room.sfpack", info, [&](int f, FrameBuffer& buffer) {
    scene->read(f, buffer);
    std::vector<std::uint16_t> ids;
    for (const std::int16_t label : buffer.label) ids.push_back(static_cast<std::uint16_t>(label + 1));
    if (with_instances) buffer.instance.assign(ids.begin(), ids.end());
    const std::string name = output_name(info.frames[static_cast<std::size_t>(f)].name);
    write_png_gray16(dir / ("segments/" + name + ".png"), buffer.width_px, buffer.height_px, ids);
  });
  std::string yaml = testing_train::with_scene(
      testing_train::hash_config("losses: [{type: depth, weight: 0.3}]\nreport: {eval_every_s: 0, strips: 0}\n"),
      "{type: packed, file: room.sfpack}");
  write_file_atomic(dir / "config.yaml", yaml);
  const Result trained = semfield("train config.yaml --out run --steps 150 --quiet", dir);
  ASSERT_EQ(trained.code, 0) << trained.err;
}

TEST(ObjectsVerb, FilesFiguresAndTheSameAgain) {
  const TempDir dir;
  make_run(dir, true);
  const Result r = semfield(std::string("objects run --score --pictures --json") + kQuick, dir);
  ASSERT_EQ(r.code, 0) << r.err;
  const auto json = nlohmann::json::parse(r.out);
  EXPECT_GT(json.at("score").at("mcov").get<double>(), 0.3);
  EXPECT_GT(json.at("objects").get<int>(), 0);
  for (const char* file : {"objects.json", "objects.csv", "objects.ply", "panoptic.json", "found.safetensors"})
    EXPECT_TRUE(fs::is_regular_file(dir / (std::string("run/objects/") + file))) << file;
  const auto table = nlohmann::json::parse(read_text_file(dir / "run/objects/objects.json"));
  ASSERT_EQ(table.at("objects").size(), json.at("objects").get<std::size_t>());
  EXPECT_EQ(table.at("objects")[0].at("id"), 1);
  const auto panoptic = nlohmann::json::parse(read_text_file(dir / "run/objects/panoptic.json"));
  ASSERT_FALSE(panoptic.at("images").empty());
  const std::string name = panoptic.at("images")[0].at("file_name");
  const Image<std::uint16_t> ids = read_ids(dir / ("run/objects/instance/" + name));
  const Image<std::uint8_t> colors = read_rgb(dir / ("run/objects/panoptic/" + name));
  std::set<int> seen;
  for (std::size_t i = 0; i < ids.pixels.size(); ++i) {
    if (ids.pixels[i] == 0) continue;
    EXPECT_EQ(colors.pixels[3 * i] + 256 * colors.pixels[3 * i + 1], ids.pixels[i]);
    seen.insert(ids.pixels[i]);
  }
  std::set<int> told;
  for (const auto& segment : panoptic.at("annotations")[0].at("segments_info"))
    if (segment.at("id") <= table.at("objects").size()) told.insert(segment.at("id").get<int>());
  EXPECT_EQ(seen, told);
  // Strips show photograph, segments, objects and truth, four panels of the view's size.
  const Image<std::uint8_t> strip = read_rgb(dir / ("run/objects/pictures/" + name));
  EXPECT_EQ(strip.width_px, 4 * ids.width_px + 3 * 4);
  EXPECT_EQ(strip.height_px, ids.height_px);
  for (std::int32_t x = 0; x < ids.width_px; ++x) {
    const auto at = [&](int panel) {
      return &strip.pixels[static_cast<std::size_t>(3 * (panel * (ids.width_px + 4) + x))];
    };
    EXPECT_EQ(ids.pixels[static_cast<std::size_t>(x)] == 0, at(2)[0] == 72 && at(2)[1] == 72 && at(2)[2] == 72) << x;
  }
  // Found anew, the same objects get the edits that were made of them; others are refused.
  const std::string first = read_text_file(dir / "run/objects/objects.csv");
  ObjectEdits edits{read_edited_objects(dir / "run/objects", 1024).edits.digest, {}};
  edits.edits.push_back(parse_object_edit(R"({"do": "rename", "object": 1, "name": "mine"})", "test"));
  fs::create_directories(dir / "again");
  write_object_edits(dir / "again/edits.json", edits);
  const Result edited = semfield(std::string("objects run --out again --json") + kQuick, dir);
  ASSERT_EQ(edited.code, 0) << edited.err;
  EXPECT_EQ(nlohmann::json::parse(edited.out).at("edits"), 1);
  EXPECT_HAS(read_text_file(dir / "again/objects.csv"), "1,mine,");
  EXPECT_HAS(read_text_file(dir / "again/objects.json"), "\"mine\"");
  // Files of the surface have the names of the edits.
  write_object_edits(dir / "run/objects/edits.json", edits);
  const Result mesh = semfield("mesh run --out room.glb --color photo --resolution 32", dir);
  ASSERT_EQ(mesh.code, 0) << mesh.err;
  EXPECT_HAS(read_text_file(dir / "room.glb"), "\"mine\"");
  EXPECT_HAS(read_text_file(dir / "room.json"), "\"mine\"");
  {
    FolderLock alone;
    ASSERT_EQ(alone.take(dir / "run/objects"), 0);
    const Result busy = semfield(std::string("objects run") + kQuick, dir);
    EXPECT_EQ(busy.code, 73);
    EXPECT_HAS(busy.err, "run/objects", "objects.folder.busy");
  }
  fs::remove(dir / "run/objects/edits.json");
  const Result others = semfield(std::string("objects run --out again") + kQuick + "--set objects.points=2000", dir);
  EXPECT_EQ(others.code, 65);
  EXPECT_HAS(others.err, "again/edits.json", "objects.edits.foreign");
  fs::remove_all(dir / "again");
  ASSERT_EQ(semfield(std::string("objects run --out again --threads 1") + kQuick, dir).code, 0);
  EXPECT_EQ(read_text_file(dir / "again/objects.csv"), first) << "threads changed a number";
}

TEST(ObjectsVerb, SegmentsOfAFolderAndBothMethods) {
  const TempDir dir;
  make_run(dir, false);
  for (const char* method : {"", "--set 'objects.method={type: assignment, slots: 12}'"}) {
    const Result r = semfield(std::string("objects run --segments segments ") + method + kQuick, dir);
    ASSERT_EQ(r.code, 0) << r.err;
    EXPECT_HAS(r.out, "objects: objects=", "segments=");
  }
  const Result none = semfield(std::string("objects run") + kQuick, dir);
  EXPECT_EQ(none.code, 65);
  EXPECT_HAS(none.err, "--segments", "objects.segments.none");
  const Result unscored = semfield(std::string("objects run --segments segments --score --out scored") + kQuick, dir);
  EXPECT_EQ(unscored.code, 65);
  EXPECT_HAS(unscored.err, "objects.truth.none");
  EXPECT_FALSE(fs::exists(dir / "scored")) << "refused before anything is written";
}

// A click into the middle of what is most of a class in a training view, as a line of clicks.jsonl.
std::string click_on(Dataset& scene, const SceneInfo& info, int class_index, const std::string& more) {
  std::vector<std::size_t> best;
  std::string line;
  for (std::size_t f = 0; f < info.frames.size(); ++f) {
    FrameBuffer buffer;
    scene.read(static_cast<int>(f), buffer);
    std::vector<std::size_t> its;
    for (std::size_t i = 0; i < buffer.label.size(); ++i)
      if (buffer.label[i] == class_index) its.push_back(i);
    if (info.frames[f].split != Split::train || its.size() <= best.size()) continue;
    best = its;
    const auto width = static_cast<std::size_t>(buffer.width_px);
    std::size_t column = 0, row = 0;
    for (const std::size_t i : its) {
      column += i % width;
      row += i / width;
    }
    const std::size_t middle = row / its.size() * width + column / its.size();
    line = fmt::format(
        R"({{"id":"c{}","type":"click","frame":"{}","size":[{},{}],"points":[[{}.5,{}.5]],"radius":1,"class":"{}"{}}})"
        "\n",
        class_index, info.frames[f].name, buffer.width_px, buffer.height_px, middle % width, middle / width,
        info.classes.valid(class_index).name, more);
  }
  return line;
}

TEST(ObjectsVerb, ThingsThatAPersonClicks) {
  const TempDir dir;
  make_run(dir, false);
  testkit::AnalyticSceneOptions options;
  options.with_depth = true;
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene(options);
  Diagnostics diagnostics;
  const SceneInfo info = scene->open(diagnostics);
  const std::string wall = click_on(*scene, info, 0, ""), ball = click_on(*scene, info, 3, ""),
                    crate = click_on(*scene, info, 4, R"(,"object":2)");
  dir.write("clicks.jsonl", wall + crate + ball);
  const Result r = semfield(std::string("objects run --segments clicks.jsonl --json") + kQuick, dir);
  ASSERT_EQ(r.code, 0) << r.err;
  EXPECT_EQ(nlohmann::json::parse(r.out).at("objects"), 2) << "a wall is no object";
  const auto table = nlohmann::json::parse(read_text_file(dir / "run/objects/objects.json")).at("objects");
  ASSERT_EQ(table.size(), 2u);
  EXPECT_EQ(table[0].at("class"), info.classes.valid(4).name) << "in the order of the clicks";
  EXPECT_EQ(table[1].at("class"), info.classes.valid(3).name);
  EXPECT_GT(table[1].at("points").get<int>(), 10);
}

}  // namespace
}  // namespace semfield
