// Tensor files, checkpoints and the run folder: round trips, every damage refused, a good checkpoint at every moment.

#include <signal.h>
#include <unistd.h>

#include <array>
#include <cmath>
#include <fstream>
#include <limits>
#include <nlohmann/json.hpp>

#include "core/checksum.h"
#include "formats/safetensors.h"
#include "tests/says.h"
#include "tests/temp_dir.h"
#include "train/checkpoint.h"
#include "train/metrics_log.h"
#include "train/run_folder.h"
#include "train/run_scores.h"

namespace semfield {
namespace {

struct Folder : ::testing::Test {
  std::string in(const std::string& name) const { return dir_ / name; }
  const TempDir dir_;
  const std::string& path_ = dir_.path();
};

std::string sample_file() {
  static const std::vector<float> weights{1, -2.5f, 3e-30f, 4, 5, 6};
  static const std::vector<double> exact{3.141592653589793};
  static const std::vector<std::int64_t> steps{-1, 1ll << 40};
  static const std::vector<std::uint8_t> grid{1, 0, 255};
  return encode_safetensors(
      {tensor_ref("grid", {3}, grid), tensor_ref("trunk_0/weight", {2, 3}, weights), tensor_ref("exact", {}, exact),
       tensor_ref("steps", {2}, steps), tensor_ref("none", {0, 4}, std::span<const float>())},
      {{"format", "semfield 1"}, {"note", "quote \" and \"semfield.crc32c\":\"11111111"}});
}

TEST(Safetensors, RoundTrip) {
  const TensorFile file = TensorFile::decode(sample_file(), "memory", {});
  EXPECT_EQ(file.tensors().size(), 5u);
  EXPECT_EQ(file.floats("trunk_0/weight", 6), (std::vector<float>{1, -2.5f, 3e-30f, 4, 5, 6}));
  EXPECT_EQ(file.integers("steps", 2), (std::vector<std::int64_t>{-1, 1ll << 40}));
  ASSERT_NE(file.find("trunk_0/weight"), nullptr);
  EXPECT_EQ(file.find("trunk_0/weight")->shape, (std::vector<std::int64_t>{2, 3}));
  EXPECT_EQ(file.find("grid")->bytes[2], std::byte{255});
  EXPECT_EQ(file.find("none")->bytes.size(), 0u);
  EXPECT_EQ(file.metadata().at("format"), "semfield 1");
  EXPECT_EQ(file.metadata().size(), 2u);
  EXPECT_HAS(error_of(ErrorKind::data, [&] { (void)file.floats("trunk_0/weight", 7); }),
             "6 elements of F32, expected 7 of F32");
  EXPECT_HAS(error_of(ErrorKind::data, [&] { (void)file.floats("absent", 1); }), "has no tensor 'absent'");
}

TEST(Safetensors, WriterChecksItsInput) {
  const std::vector<float> values{1, 2};
  EXPECT_NE(error_of(ErrorKind::internal, [&] { (void)encode_safetensors({tensor_ref("w", {3}, values)}, {}); }), "");
  EXPECT_NE(error_of(ErrorKind::internal,
                     [&] {
                       (void)encode_safetensors({tensor_ref("w", {2}, values), tensor_ref("w", {2}, values)}, {});
                     }),
            "");
}

// What would be cut to the size of a number of ours, or turn negative, is refused where it is read.
TEST(CheckpointFacts, NumbersThatCannotBeAreRefused) {
  CheckpointFacts facts;
  facts.clicks = EventsKnown{3, 7};
  KnownScene& scene = facts.scene;
  scene.manifest.classes = 1;
  scene.manifest.train_class_pixels = {5};
  scene.manifest.train_pixels = 10;
  scene.pixel_footprint_m = 0.5;
  facts.inputs.frames = 4;
  const auto decoded = [](const TensorMetadata& metadata) {
    return TensorFile::decode(encode_safetensors({}, metadata), "a.safetensors", {});
  };
  const auto read = [&](const char* key, const std::string& good, const std::string& bad) {
    TensorMetadata metadata = checkpoint_metadata(facts, "hash");
    std::string& text = metadata.at(key);
    const std::size_t at = text.find(good);
    EXPECT_NE(at, std::string::npos) << key << ": " << text;
    text.replace(at, good.size(), bad);
    (void)read_checkpoint_facts(decoded(metadata));
  };
  read("scene", "10", "10");
  const std::array<const char*, 3> cases[] = {{"scene", "\"classes\":1", "\"classes\":4294967297"},
                                              {"scene", "\"classes\":1", "\"classes\":1.5"},
                                              {"scene", "\"train_pixels\":10", "\"train_pixels\":-1"},
                                              {"scene", "\"train_pixels\":10", "\"train_pixels\":18446744073709551615"},
                                              {"scene", "[5]", "[-5]"},
                                              {"inputs", "\"frames\":4", "\"frames\":1e30"},
                                              {"clicks", "3 ", "99999999999999999999 "},
                                              {"clicks", "3 ", "-3 "},
                                              {"step", "0", "18446744073709551615"},
                                              {"train_s", "0", "nan"},
                                              {"train_s", "0", "soon"},
                                              {"seed", "0", "4294967296"}};
  for (const auto& [key, good, bad] : cases) EXPECT_ERROR(read(key, good, bad), "checkpoint.metadata.damaged", key);
  for (const char* key : {"format", "step", "train_s", "seed", "config", "classes", "scene", "inputs"}) {
    TensorMetadata metadata = checkpoint_metadata(facts, "hash");
    ASSERT_EQ(metadata.erase(key), 1u) << key;
    const bool old = key == std::string_view("scene") || key == std::string_view("inputs");  // no such key before 1.0
    const Code code = old ? Code("checkpoint.file.version") : Code("checkpoint.metadata.damaged");
    EXPECT_ERROR(read_checkpoint_facts(decoded(metadata)), code, "a.safetensors", key);
  }
  EXPECT_ERROR(read_checkpoint_facts(decoded(checkpoint_metadata(facts, "hash")), 5), "checkpoint.file.name",
               "its name says step 5, its metadata step 0", "step_00000000.safetensors");
}

using CheckpointTest = Folder;

void save(CheckpointStore& store, std::int64_t step) {
  const std::vector<float> values{static_cast<float>(step)};
  store.save(step, {tensor_ref("w", {1}, values)}, {{"step", std::to_string(step)}});
}

TEST_F(CheckpointTest, KeepsTheNewestAndNamesTheLatest) {
  CheckpointStore store(in("checkpoints"), 2);
  Diagnostics diagnostics;
  EXPECT_FALSE(store.find_latest(diagnostics).has_value());
  for (std::int64_t step : {100, 200, 300}) save(store, step);
  ASSERT_EQ(store.list().size(), 2u);
  EXPECT_EQ(store.list()[1].step, 200);
  EXPECT_EQ(read_text_file(in("checkpoints/latest")), "step_00000300.safetensors\n");
  const auto found = store.find_latest(diagnostics);
  ASSERT_TRUE(found.has_value());
  EXPECT_EQ(found->step, 300);
  EXPECT_EQ(found->file.floats("w", 1)[0], 300.0f);
  EXPECT_TRUE(diagnostics.all().empty());
}

// A folder in the place of the file: root meets that too.
TEST_F(CheckpointTest, ASaveThatFailsNamesTheCheckpointThatIsKept) {
  CheckpointStore store(in("c"));
  save(store, 100);
  fs::create_directories(in("c/" + CheckpointStore::file_name(200) + "/x"));
  EXPECT_HAS(error_of(ErrorKind::io, [&] { save(store, 200); }), "while saving the checkpoint of step 200",
             "the checkpoint of step 100 is kept");
  Diagnostics found;
  EXPECT_EQ(store.find_latest(found)->step, 100);
}

TEST_F(CheckpointTest, StaleTemporaryFilesGoAndOtherFilesStay) {
  fs::create_directories(in("c"));
  std::ofstream(in("c/.step_00000001.safetensors.77.0.tmp")) << "torn";
  std::ofstream(in("c/notes.txt")) << "mine";
  CheckpointStore store(in("c"));
  EXPECT_FALSE(fs::exists(in("c/.step_00000001.safetensors.77.0.tmp")));
  EXPECT_TRUE(fs::exists(in("c/notes.txt")));
}

// What evaluation uses, beside a run that trains.
TEST_F(CheckpointTest, ReadingChangesNothing) {
  {
    CheckpointStore store(in("c"));
    save(store, 100);
  }
  std::ofstream(in("c/.step_00000200.safetensors.0.tmp")) << "being written";
  const CheckpointStore reader = CheckpointStore::read(in("c"));
  Diagnostics diagnostics;
  EXPECT_EQ(reader.find_latest(diagnostics)->step, 100);
  EXPECT_TRUE(fs::exists(in("c/.step_00000200.safetensors.0.tmp")));
  EXPECT_FALSE(CheckpointStore::read(in("none")).find_latest(diagnostics).has_value());
  EXPECT_FALSE(fs::exists(in("none")));
}

// Taken for an empty one, the run would start over and put its own checkpoints aside.
TEST_F(CheckpointTest, AFolderThatCannotBeReadIsNoEmptyFolder) {
  std::ofstream(in("c")) << "a file where the folder should be";
  const std::string message = error_of(ErrorKind::io, [&] { (void)CheckpointStore::read(in("c")).list(); });
  EXPECT_HAS(message, "cannot read the folder '" + in("c") + "': Not a directory");
}

using RunFolderTest = Folder;

TEST_F(RunFolderTest, WhatKilledRunsLeftIsRemoved) {
  // Killed before run.yaml was there: the same command works again.
  fs::create_directories(in("run"));
  std::ofstream(in("run/.lock")) << "77\n";
  std::ofstream(in("run/.run.yaml.0.tmp")) << "torn";
  {
    const RunFolder run = RunFolder::create(in("run"));
    EXPECT_FALSE(fs::exists(in("run/.run.yaml.0.tmp")));
    write_file_atomic(run.config_path(), "a: 1\n");
    fs::create_directories(in("run/render/test"));
  }
  for (const char* name :
       {"run/.report.html.0.tmp", "run/render/test/.0017_rgb.png.1.tmp", "run/.classes.yaml.77.3.tmp"})
    std::ofstream(in(name)) << "torn";
  const RunFolder run = RunFolder::resume(in("run"));
  for (const auto& entry : fs::recursive_directory_iterator(in("run")))
    EXPECT_NE(entry.path().extension(), ".tmp") << entry.path();
}

TEST_F(RunFolderTest, CreateRefusesFilesAndResumeNeedsARun) {
  {
    const RunFolder run = RunFolder::create(in("new/run"));
    EXPECT_EQ(run.config_path(), in("new/run/run.yaml"));
    EXPECT_EQ(run.render_path("test", "seq/0017", "depth"), in("new/run/render/test/seq_0017_depth.png"));
    EXPECT_TRUE(fs::is_directory(in("new/run/render/test")));
  }
  EXPECT_HAS(error_of(ErrorKind::cannot_create, [&] { (void)RunFolder::create(in("new/run")); }),
             "holds files already");
  EXPECT_HAS(error_of(ErrorKind::no_input, [&] { (void)RunFolder::resume(in("new/run")); }), "no run.yaml");
  write_file_atomic(in("new/run/run.yaml"), "a: 1\n");
  EXPECT_NO_THROW((void)RunFolder::resume(in("new/run")));
  EXPECT_NE(error_of(ErrorKind::no_input, [&] { (void)RunFolder::read(in("absent")); }), "");
  // A folder of other files stays as it was.
  fs::create_directories(in("photos"));
  std::ofstream(in("photos/a.jpg")) << "x";
  EXPECT_NE(error_of(ErrorKind::cannot_create, [&] { (void)RunFolder::create(in("photos")); }), "");
  EXPECT_FALSE(fs::exists(in("photos/.lock")));
}

TEST_F(RunFolderTest, EnvironmentAndLeftOutRoundTrip) {
  Environment e = this_environment();
  EXPECT_FALSE(e.compiler.empty());
  EXPECT_GE(e.hardware_threads, 1);
  e.seed = 18446744073709551615ull;
  e.modules = {"hash_grid 1.0", "nerf_mlp 1.0"};
  const auto entries = parse_environment(environment_json(e), "environment.json");
  const auto value = [&](const std::string& key) {
    for (const auto& [name, text] : entries) {
      if (name == key) return text;
    }
    return std::string("absent");
  };
  EXPECT_EQ(value("seed"), "18446744073709551615");
  EXPECT_EQ(value("modules"), "hash_grid 1.0, nerf_mlp 1.0");
  const auto read = nlohmann::json::parse(
      left_out_json({{"semantic head", "no labels", "0 label files", ProofClass::bitwise, "6.9 %"}}));
  ASSERT_EQ(read.size(), 1u);
  EXPECT_EQ(read[0]["evidence"], "0 label files");
  EXPECT_EQ(read[0]["proof"], "B");
  EXPECT_TRUE(read[0]["saving_measured"].is_null());
  EXPECT_NE(error_of(ErrorKind::data, [] { (void)parse_environment("{", "environment.json"); }), "");
}

// A curve that gains `first_db` from 16 s to 32 s, and `last_db` from there to 64 s, its end.
std::optional<Outlook> outlook_of(double first_db, double last_db, double psnr_db) {
  std::vector<MetricsRow> rows;
  for (int t = 1; t <= 64; ++t) {
    MetricsRow& row = rows.emplace_back();
    row.train_s = t;
    row.set("psnr", 18 + (t > 16 ? first_db : 0) + (t > 32 ? last_db : 0));
  }
  return outlook(rows, 64, psnr_db);
}

TEST(Outlook, ABriefTrainingIsToldForHowLongToGoOn) {
  const std::optional<Outlook> more = outlook_of(2, 1, 20);  // 0.5 dB for another 64 s, then 0.25
  ASSERT_TRUE(more);
  EXPECT_DOUBLE_EQ(more->more_s, 64);
  EXPECT_NEAR(more->gain_db, 0.5, 1e-9);
  EXPECT_DOUBLE_EQ(outlook_of(2, 1.6, 20)->more_s, 64 * 15) << "1.28, 1.02, 0.82 and 0.66 dB, and then it is enough";
  EXPECT_DOUBLE_EQ(outlook_of(2, 1.6, 24)->more_s, 64) << "25 dB are enough to show";
  EXPECT_FALSE(outlook_of(2, 1.6, 25));
  EXPECT_FALSE(outlook_of(1, 0.4, 18)) << "more of the same training hardly helps";
  EXPECT_FALSE(outlook({}, 64, 18)) << "no curve, no outlook";
}

// metrics.jsonl, read back also by code that shares nothing with its writer.

struct LogTest : ::testing::Test {
  std::string in(const std::string& name) const { return dir_ / name; }
  const TempDir dir_;
};

MetricsRow train_row(std::int64_t step) {
  MetricsRow row{.step = step, .train_s = 0.1 * static_cast<double>(step)};
  row.set("loss", 1.0 / 3);
  return row;
}

TEST_F(LogTest, RowsComeBackExactly) {
  {
    MetricsLog log = MetricsLog::resume(in("metrics.jsonl"), 0);
    log.append(train_row(7));
    MetricsRow row{.kind = "eval", .step = 7, .split = "test"};
    row.set("psnr", std::numeric_limits<double>::infinity());
    row.set("miou", std::nullopt);
    row.set("absrel", std::numeric_limits<double>::quiet_NaN());
    row.per_class_iou = {{"wall", 0.25}, {"a \"b\"\n", std::nullopt}};
    log.append(row);
  }
  const auto rows = read_metrics(in("metrics.jsonl"));
  ASSERT_EQ(rows.size(), 2u);
  EXPECT_EQ(rows[0].kind, "train");
  EXPECT_EQ(rows[0].get("loss"), 1.0 / 3);
  EXPECT_EQ(rows[0].train_s, 0.1 * 7);
  EXPECT_EQ(rows[1].get("psnr"), std::numeric_limits<double>::infinity());
  EXPECT_FALSE(rows[1].get("miou").has_value());
  EXPECT_TRUE(std::isnan(*rows[1].get("absrel")));
  EXPECT_EQ(rows[1].per_class_iou[1].first, "a \"b\"\n");
  // Any JSON reader can read every line.
  std::ifstream file(in("metrics.jsonl"));
  std::string line;
  ASSERT_TRUE(std::getline(file, line) && std::getline(file, line));
  const auto json = nlohmann::json::parse(line);
  EXPECT_EQ(json.at("psnr"), "inf");
  EXPECT_EQ(json.at("split"), "test");
  EXPECT_TRUE(json.at("miou").is_null());
  EXPECT_FALSE(std::getline(file, line));
}

TEST_F(LogTest, OnlyATornLastLineIsForgiven) {
  const std::string good = metrics_line(train_row(1)) + "\n" + metrics_line(train_row(2)) + "\n";
  for (std::size_t cut = 0; cut <= good.size(); ++cut) {
    const auto rows = parse_metrics(good.substr(0, cut), "m");
    EXPECT_EQ(rows.size(), cut == good.size() ? 2u : cut >= good.find('\n') + 1 ? 1u : 0u);
  }
  EXPECT_HAS(error_of(ErrorKind::data, [&] { (void)parse_metrics("{\"kind\":\"train\",\n" + good, "metrics.jsonl"); }),
             "metrics.jsonl:1: not a JSON object");
  EXPECT_THROW((void)parse_metrics("{\"kind\":\"train\"}\n", "m"), Error);
  EXPECT_THROW((void)parse_metrics("{\"step\":1,\"loss\":\"high\"}\n", "m"), Error);
}

TEST_F(LogTest, ResumeDropsLaterRowsAndTheTornLine) {
  {
    MetricsLog log = MetricsLog::resume(in("m"), 0);
    for (std::int64_t step : {10, 20, 30}) log.append(train_row(step));
  }
  std::ofstream(in("m"), std::ios::app) << "{\"kind\":\"tra";
  {
    MetricsLog log = MetricsLog::resume(in("m"), 20);
    log.append(train_row(25));
  }
  const auto rows = read_metrics(in("m"));
  ASSERT_EQ(rows.size(), 3u);
  EXPECT_EQ(rows[1].step, 20);
  EXPECT_EQ(rows[2].step, 25);
}

// After a power cut lines behind the last sync may be anything; ahead of a row that is kept they may not.
TEST_F(LogTest, ResumeDropsWhatAPowerCutLeftAndRefusesOtherDamage) {
  const std::string good = metrics_line(train_row(10)) + "\n" + metrics_line(train_row(20)) + "\n";
  const std::string zeros(50, '\0'), later = metrics_line(train_row(30)) + "\n";
  std::ofstream(in("m")) << good << zeros << "\n" << later << zeros;
  {
    MetricsLog log = MetricsLog::resume(in("m"), 20);
    log.append(train_row(25));
    log.sync();
  }
  EXPECT_EQ(read_text_file(in("m")), good + metrics_line(train_row(25)) + "\n");
  std::ofstream(in("n")) << "half a row}\n" << good;
  EXPECT_HAS(error_of(ErrorKind::data, [&] { (void)MetricsLog::resume(in("n"), 20); }),
             in("n") + ":1: not a JSON object");
}

}  // namespace
}  // namespace semfield
