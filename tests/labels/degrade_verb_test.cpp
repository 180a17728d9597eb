// `semfield degrade`: the program on a tiny room; what it wrote is read back.
#include <algorithm>
#include <cstring>
#include <nlohmann/json.hpp>

#include "scene/classes/class_table.h"
#include "system/files.h"
#include "tests/labels/degradation_testing.h"
#include "tests/program.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using namespace testing_program;
using testing_room::fresh_folder;

// A room of 5 frames of which 0, 2 and 4 train; returns the configuration's path.
std::string write_config(const std::string& folder, const std::string& labels) {
  fs::create_directories(folder + "/room");
  testing_room::write_replica(folder + "/room", 5);
  std::string yaml = "include: " + std::string(SEMFIELD_SOURCE_DIR) + "/configs/presets/room.yaml\n";
  yaml += "scene: {type: replica, root: room, train_step: 2, test_step: 2, test_offset: 1, labels: " + labels + "}\n";
  write_file_atomic(folder + "/room.yaml", std::string_view(yaml));
  return folder + "/room.yaml";
}

nlohmann::json manifest_of(const std::string& folder) {
  return nlohmann::json::parse(read_text_file(folder + "/manifest.json"));
}

std::vector<std::string> names_in(const std::string& folder) {
  std::vector<std::string> out;
  for (const auto& entry : fs::directory_iterator(folder)) out.push_back(entry.path().filename().string());
  std::sort(out.begin(), out.end());
  return out;
}

TEST(DegradeVerb, WritesIdsPreviewsClassesAndAManifestThatAgree) {
  const std::string folder = fresh_folder("hard");
  const std::string config = write_config(
      folder, "{seed: 3, degrade: [{type: super_resolution, factor: 4, mode: sparse}, {type: pixel_noise}]}");
  const Result r = semfield_run("degrade " + shell_word(config) + " --out labels", folder);
  ASSERT_EQ(r.code, 0) << r.err;
  EXPECT_EQ(names_in(folder), (std::vector<std::string>{"labels", "room", "room.yaml", "stderr", "stdout"}));
  const std::string out = folder + "/labels";
  EXPECT_EQ(names_in(out), (std::vector<std::string>{"classes.yaml", "manifest.json", "preview", "semantic_class"}));
  EXPECT_EQ(names_in(out + "/semantic_class"),
            (std::vector<std::string>{"semantic_class_0.png", "semantic_class_2.png", "semantic_class_4.png"}));
  EXPECT_EQ(ClassTable::load(out + "/classes.yaml").valid_count(), 6);

  const nlohmann::json m = manifest_of(out);
  EXPECT_EQ(m["seed"], 3);
  EXPECT_EQ(m["labels_from"], "the scene");
  ASSERT_EQ(m["steps"].size(), 2u);
  EXPECT_EQ(m["steps"][0]["type"], "super_resolution");
  EXPECT_EQ(m["steps"][1]["facts"]["pixels drawn"], "1800");
  EXPECT_HAS(m["config"].get<std::string>(), "pixel_noise");

  // The figures, counted again from the images.
  std::int64_t labelled = 0, changed = 0, right = 0;
  for (const nlohmann::json& frame : m["frames"]) {
    const Image<std::uint16_t> given = read_ids(out + "/" + frame["label"].get<std::string>());
    const Image<std::uint16_t> preview = read_ids(out + "/" + frame["preview"].get<std::string>());
    const Image<std::uint16_t> truth = read_ids(folder + "/room/" + frame["label"].get<std::string>());
    ASSERT_EQ(given.pixels.size(), 1200u);
    EXPECT_EQ(given.pixels, preview.pixels);
    std::int64_t in_frame = 0;
    for (std::size_t p = 0; p < given.pixels.size(); ++p) {
      in_frame += given.pixels[p] != 0;
      changed += given.pixels[p] != truth.pixels[p];
      right += given.pixels[p] != 0 && given.pixels[p] == truth.pixels[p];
      EXPECT_TRUE(given.pixels[p] == 0 || (p % 4 == 0 && p / 40 % 4 == 0));
    }
    EXPECT_EQ(frame["labelled_px"], in_frame);
    labelled += in_frame;
  }
  EXPECT_EQ(m["total"]["labelled_px"], labelled);
  EXPECT_EQ(m["total"]["changed_px"], changed);
  EXPECT_DOUBLE_EQ(m["total"]["accuracy"], static_cast<double>(right) / static_cast<double>(labelled));
  EXPECT_EQ(r.out.rfind("degrade: frames=3 labelled_px=" + std::to_string(labelled) + " accuracy=0.", 0), 0u) << r.out;
}

TEST(DegradeVerb, SoftLabelsAreWrittenAsProbabilities) {
  const std::string folder = fresh_folder("soft");
  const std::string config = write_config(folder, "{frames: 2, degrade: [{type: simulated_predictions}]}");
  const std::string out = folder + "/labels";
  const Result r = semfield_run("degrade " + shell_word(config) + " --out labels/", folder);
  ASSERT_EQ(r.code, 0) << r.err;
  const nlohmann::json m = manifest_of(out);
  ASSERT_EQ(m["frames"].size(), 2u);
  EXPECT_EQ(m["steps"][0]["facts"]["simulated"], "true");
  for (const nlohmann::json& frame : m["frames"]) {
    const std::string npy = read_text_file(out + "/" + frame["probability"].get<std::string>());
    EXPECT_HAS(npy, "'shape': (30, 40, 6)");
    const std::size_t bytes = std::size_t{30} * 40 * 6 * 4;
    ASSERT_GT(npy.size(), bytes);
    std::vector<float> values(bytes / 4);
    std::memcpy(values.data(), npy.data() + npy.size() - bytes, bytes);
    const Image<std::uint16_t> given = read_ids(out + "/" + frame["label"].get<std::string>());
    for (std::size_t p = 0; p < given.pixels.size(); ++p) {
      const auto row = values.begin() + static_cast<std::ptrdiff_t>(6 * p);
      EXPECT_EQ(given.pixels[p], std::max_element(row, row + 6) - row + 1);
    }
  }
}

// What was written is read as label files, and written again.
TEST(DegradeVerb, WrittenLabelsComeBackThroughTheReaders) {
  const std::string folder = fresh_folder("again");
  const std::string config = write_config(folder, "{frames: 2, degrade: [{type: simulated_predictions, strength: 2}]}");
  ASSERT_EQ(semfield_run("degrade " + shell_word(config) + " --out first", folder).code, 0);
  const std::vector<std::string> images = names_in(folder + "/first/semantic_class");
  ASSERT_EQ(images.size(), 2u);
  for (const auto& [kind, from] : std::vector<std::pair<std::string, std::string>>{
           {"images", "{type: images, folder: first/semantic_class, pattern: 'semantic_class_{number}.png'}"},
           {"npz", "{type: npz, folder: first/probability, pattern: '{name}.npy'}"}}) {
    const std::string again = write_config(folder, "{from: " + from + "}");
    const Result r = semfield_run("degrade " + shell_word(again) + " --out " + kind, folder);
    ASSERT_EQ(r.code, 0) << r.err;
    EXPECT_EQ(names_in(folder + "/" + kind + "/semantic_class"), images);
    for (const std::string& name : images)
      EXPECT_EQ(read_text_file(folder + "/first/semantic_class/" + name),
                read_text_file(folder + "/" + kind + "/semantic_class/" + name));
    EXPECT_EQ(manifest_of(folder + "/first")["total"], manifest_of(folder + "/" + kind)["total"]);
    EXPECT_EQ(manifest_of(folder + "/" + kind)["labels_from"], kind);
  }
  for (const std::string& name : names_in(folder + "/first/probability"))
    EXPECT_EQ(read_text_file(folder + "/first/probability/" + name),
              read_text_file(folder + "/npz/probability/" + name));
}

TEST(DegradeVerb, ATableWithoutVoidGetsAnIdForIt) {
  const std::string folder = fresh_folder("void");
  const std::string config = write_config(folder, "{degrade: [{type: propagation}]}");
  write_file_atomic(folder + "/room/classes.yaml",
                    std::string_view("- {id: 1, name: west}\n- {id: 2, name: east}\n- {id: 3, name: ceiling}\n"
                                     "- {id: 4, name: floor}\n- {id: 5, name: south}\n- {id: 6, name: north}\n"));
  fs::create_directories(folder + "/labels");  // an empty folder may be there
  const Result r = semfield_run("degrade " + shell_word(config) + " --out labels", folder);
  ASSERT_EQ(r.code, 0) << r.err;
  const ClassTable table = ClassTable::load(folder + "/labels/classes.yaml");
  EXPECT_EQ(table.index_of(0), kVoid);
  EXPECT_EQ(table.valid_count(), 6);
  const Image<std::uint16_t> given = read_ids(folder + "/labels/semantic_class/semantic_class_2.png");
  EXPECT_GT(std::count(given.pixels.begin(), given.pixels.end(), 0), 1190);
}

TEST(DegradeVerb, TheSameLabelsAsBefore) {
  const std::string folder = fresh_folder("same");
  const std::string config = write_config(folder, "{degrade: [{type: pixel_noise}, {type: region_noise}]}");
  for (const char* name : {"a", "b"}) {
    const Result r = semfield_run("degrade " + shell_word(config) + " --out " + name +
                                      (*name == 'a' ? " --set runtime.threads=1" : " --set runtime.threads=3"),
                                  folder);
    ASSERT_EQ(r.code, 0) << r.err;
  }
  for (const std::string& name : names_in(folder + "/a/semantic_class"))
    EXPECT_EQ(read_text_file(folder + "/a/semantic_class/" + name),
              read_text_file(folder + "/b/semantic_class/" + name));
}

TEST(DegradeVerb, AUsedFolderAndProblemsLeaveNothingBehind) {
  const std::string folder = fresh_folder("used");
  const std::string config = write_config(folder, "{degrade: [{type: region_noise, instances: [77]}]}");
  fs::create_directories(folder + "/full");
  testing_room::plain_write(folder + "/full/mine.txt", "keep");
  Result r = semfield_run("degrade " + shell_word(config) + " --out full", folder);
  EXPECT_EQ(r.code, static_cast<int>(ErrorKind::cannot_create));
  EXPECT_HAS(r.err, "holds files already");
  EXPECT_EQ(names_in(folder + "/full"), (std::vector<std::string>{"mine.txt"}));

  r = semfield_run("degrade " + shell_word(config) + " --out new", folder);
  EXPECT_EQ(r.code, static_cast<int>(ErrorKind::data));
  EXPECT_HAS(r.err, "no labelled training frame sees instance 77");
  r = semfield_run("degrade " + shell_word(config) + " --out new --set scene.labels.frames=none --set " +
                       "'scene.labels.degrade=[]'",
                   folder);
  EXPECT_EQ(r.code, static_cast<int>(ErrorKind::data));
  EXPECT_HAS(r.err, "no training frame keeps labels");
  testing_room::plain_write(folder + "/room/semantic_class/semantic_class_2.png", "no image");
  r = semfield_run("degrade " + shell_word(config) + " --out new", folder);
  EXPECT_EQ(r.code, static_cast<int>(ErrorKind::data));
  EXPECT_HAS(r.err, "semantic_class_2.png");
  EXPECT_EQ(names_in(folder), (std::vector<std::string>{"full", "room", "room.yaml", "stderr", "stdout"}));
}

TEST(DegradeVerb, AnErrorWhileWritingRemovesWhatWasWritten) {
  const std::string folder = fresh_folder("limit");
  const std::string config = write_config(folder, "{degrade: [{type: simulated_predictions}]}");
  // Files may have 8 KiB at most: images fit, probabilities do not.
  const Result r = semfield_run("degrade " + shell_word(config) + " --out labels", folder, "ulimit -f 16; ");
  EXPECT_EQ(r.code, static_cast<int>(ErrorKind::io));
  EXPECT_HAS(r.err, "probability");
  EXPECT_EQ(names_in(folder), (std::vector<std::string>{"room", "room.yaml", "stderr", "stdout"}));
}

}  // namespace
}  // namespace semfield
