// A run's files say what was trained, and the program says what does not go with them.
#include <regex>

#include "formats/safetensors.h"
#include "run/run_folder.h"
#include "system/files.h"
#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using namespace testing_train;
using namespace testing_program;

TEST(RunTruth, AFolderThatIsNoUtf8IsRefusedBeforeTraining) {
  const TempDir dir;
  const std::string folder = dir / "caf\xe9";
  fs::create_directory(folder);
  write_packed_config(dir, 5, 0);
  fs::copy(dir.path(), folder, fs::copy_options::none);  // files alone
  const Result r = semfield_run("train config.yaml --out run", folder);
  EXPECT_EQ(r.code, 78) << r.err;
  EXPECT_HAS(r.err, "it is not UTF-8; nothing was written; give the folder or file another name", "caf\\xe9");
  EXPECT_FALSE(fs::exists(folder + "/run"));
  // Where only the run folder's name is none, the run's files hold no part of it.
  const Result named = semfield_run("train config.yaml --threads 1 --out caf\xe9/run", dir.path());
  EXPECT_EQ(named.code, 0) << named.err;
  const Result json = semfield_run("--json eval caf\xe9/run", dir.path());
  EXPECT_EQ(json.code, 0) << json.err;
}

// The newest checkpoint with its metadata changed, checksums and all.
void edit_metadata(const std::string& run, int step, const std::function<void(TensorMetadata&)>& edit) {
  const std::string path = run + "/checkpoints/" + CheckpointStore::file_name(step);
  const TensorFile file = TensorFile::read(path);
  TensorMetadata metadata = file.metadata();
  edit(metadata);
  write_safetensors(path, file.tensors(), metadata);
}

struct Edit {
  std::string key, value;  ///< value "-": the key is removed
  int code;
  std::string said;
};

TEST(RunTruth, CheckpointMetadataIsReadStrictly) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 5, 0);
  ASSERT_EQ(semfield_run("train config.yaml --threads 1 --out run", dir.path()).code, 0);
  const std::string file = "step_00000005.safetensors': ";
  const std::vector<Edit> edits{
      {"format", "semfield-checkpoint-9", 65,
       file + "its format is 'semfield-checkpoint-9', this program reads 'semfield-checkpoint-1'"},
      {"format", "-", 65, file + "metadata 'format' is missing"},
      {"step", "6", 65, file + "its name says step 5, its metadata step 6; name it step_00000006.safetensors"},
      {"step", "5x", 65, file + "metadata 'step' is '5x', no number of that kind"},
      {"step", "99999999999999999999", 65, file + "metadata 'step' is"},
      {"train_s", "-", 65, file + "metadata 'train_s' is missing"},
      {"train_s", "soon", 65, file + "metadata 'train_s' is 'soon'"},
      {"train_s", "nan", 65, file + "metadata 'train_s' is 'nan'"},
      {"train_s", "-1", 65, file + "metadata 'train_s' is '-1'"},
      {"seed", "-", 65, file + "metadata 'seed' is missing"},
      {"seed", "4294967296", 65, file + "metadata 'seed' is '4294967296'"},
      {"config", "-", 65, file + "metadata 'config' is missing"},
      {"classes", "-", 65, file + "metadata 'classes' is missing"},
      {"classes", "- {id: 1", 65, "checkpoint metadata 'classes':1:3: a list or a map where a key should stand"},
      {"inputs", "{}", 65, file + "metadata 'inputs' cannot be read"},
      {"inputs", "-", 0, ""},  // of an earlier version
      {"scene", "{\"classes\": 1000000}", 65, "metadata 'scene' cannot be read"},
  };
  const std::string saved = read_text_file((dir / "run") + "/checkpoints/step_00000005.safetensors");
  for (const Edit& e : edits) {
    SCOPED_TRACE(e.key + "=" + e.value);
    edit_metadata(dir / "run", 5, [&](TensorMetadata& metadata) {
      if (e.value == "-") metadata.erase(e.key);
      if (e.value != "-") metadata[e.key] = e.value;
    });
    for (const char* words : {"eval run", "train --resume run"}) {
      const Result r = semfield_run(words, dir.path());
      EXPECT_EQ(r.code, e.code) << words << ": " << r.err;
      EXPECT_HAS(r.err, e.said) << "not said: " << e.said << "\nbut: " << r.err;
    }
    write_file_atomic((dir / "run") + "/checkpoints/step_00000005.safetensors", saved);
  }
  edit_metadata(dir / "run", 5, [](TensorMetadata& metadata) { metadata["seed"] = "9"; });
  const Result seed = semfield_run("train --resume run", dir.path());
  EXPECT_EQ(seed.code, 65);
  EXPECT_HAS(seed.err, "its seed is 9, its settings say 1");
}

TEST(RunTruth, SettingsOfAResumeAreStoredAndTold) {
  const TempDir dir;
  write_packed_config(dir, 5, 0);
  ASSERT_EQ(semfield_run("train config.yaml --threads 1 --out run", dir.path()).code, 0);
  const Result more = semfield_run("train --resume run --set train.steps=9 --set report.strips=1", dir.path());
  ASSERT_EQ(more.code, 0) << more.err;
  EXPECT_HAS(more.err, "from step 5 on: train.steps: 5 -> 9");
  const std::string yaml = read_text_file((dir / "run") + "/run.yaml");
  EXPECT_HAS(yaml, "\n  steps: 9\n", "\n  strips: 1\n");
  // The next resume reads what the last one was given, and the report shows both.
  const Result again = semfield_run("train --resume run --set train.steps=12", dir.path());
  ASSERT_EQ(again.code, 0) << again.err;
  EXPECT_HAS(again.err, "from step 9 on: train.steps: 9 -> 12");
  EXPECT_LACKS(again.err, "strips");
  const std::vector<std::string> changes =
      parse_settings_changed(read_text_file((dir / "run") + "/environment.json"), "environment.json");
  EXPECT_EQ(changes, (std::vector<std::string>{"step 5: train.steps: 5 -> 9", "step 5: report.strips: 0 -> 1",
                                               "step 9: train.steps: 9 -> 12"}));
  EXPECT_HAS(read_text_file((dir / "run") + "/report.html"), "step 9: train.steps");
  // A run.yaml that says something else than its checkpoint, as earlier versions left them.
  std::string other = yaml;
  other.replace(other.find("\n  rays: "), 9, "\n  rays: 1");
  write_file_atomic((dir / "run") + "/run.yaml", other);
  const Result refused = semfield_run("train --resume run", dir.path());
  EXPECT_EQ(refused.code, 78) << refused.err;
  const std::size_t at = refused.err.find("semfield train --resume run --set train.rays=");
  ASSERT_NE(at, std::string::npos) << refused.err;
  const std::string words = refused.err.substr(at + 9, refused.err.find(';', at) - at - 9);
  EXPECT_EQ(semfield_run(words, dir.path()).code, 0) << "the remedy does what it says: " << words;
}

// Data that moved are found from another working folder, and stay found.
TEST(RunTruth, MovedDataAreNamedOnTheCommandLine) {
  const TempDir dir;
  write_packed_config(dir, 5, 0);
  ASSERT_EQ(semfield_run("train config.yaml --threads 1 --out run", dir.path()).code, 0);
  fs::create_directory(dir / "elsewhere");
  const std::string file = [&] {
    for (const auto& entry : fs::directory_iterator(dir.path()))
      if (entry.path().extension() == ".sfpack") return entry.path().filename().string();
    return std::string();
  }();
  ASSERT_NE(file, "");
  fs::rename(dir / file, (dir / "elsewhere") + "/moved.sfpack");
  const Result gone = semfield_run("eval run", dir.path());
  EXPECT_EQ(gone.code, 66) << gone.err;
  EXPECT_HAS(gone.err, "if the data moved, add --set scene.file=NEW_PLACE");
  const Result found = semfield_run("eval ../run --set scene.file=moved.sfpack", dir / "elsewhere");
  EXPECT_EQ(found.code, 0) << found.err;
  const Result stored = semfield_run("train --resume ../run --set scene.file=moved.sfpack", dir / "elsewhere");
  EXPECT_EQ(stored.code, 0) << stored.err;
  EXPECT_EQ(semfield_run("eval run", dir.path()).code, 0);
}

TEST(RunTruth, RunsEqualComparesWhatWasTrained) {
  const TempDir dir;
  write_packed_config(dir, 8, 0);
  const auto train = [&](const std::string& name, const std::string& more) {
    const Result r = semfield_run("train config.yaml --out " + name + " " + more, dir.path());
    ASSERT_EQ(r.code, 0) << r.err;
  };
  train("a", "--threads 1");
  train("b", "--threads 2 --set report.log_every_steps=3 --memory 100");
  train("seed", "--threads 1 --set runtime.seed=7");
  train("longer", "--threads 1 --steps 9");
  const auto compare = [&](const std::string& other, int code, const std::string& said) {
    const Result r = semfield_run("runs equal a " + other, dir.path());
    EXPECT_EQ(r.code, code) << r.err;
    EXPECT_EQ(r.out.substr(0, said.size()), said);
  };
  compare("b", 0, "runs: equal step=8 tensors=");
  compare("seed", 1, "runs: different: runtime.seed: 1 -> 7\n");
  compare("longer", 1, "runs: different: step: 8 -> 9\n");
  // Equal runs have the same identity, whatever their threads.
  const auto hash_of = [&](const std::string& name) {
    return TensorFile::read(dir / (name + "/checkpoints/step_00000008.safetensors")).metadata().at("config_hash");
  };
  EXPECT_EQ(hash_of("a"), hash_of("b"));
  EXPECT_NE(hash_of("a"), hash_of("seed"));
  const std::string path = dir / "b/checkpoints/step_00000008.safetensors";
  const TensorFile file = TensorFile::read(path);
  std::vector<TensorRef> tensors = file.tensors();
  std::vector<std::byte> bytes(tensors[1].bytes.begin(), tensors[1].bytes.end());
  bytes[8] ^= std::byte{1};  // the lowest bit of element 2
  tensors[1].bytes = bytes;
  write_safetensors(path, tensors, file.metadata());
  compare("b", 1, "runs: different: tensor '" + tensors[1].name + "' differs from element 2 on\n");
  EXPECT_EQ(semfield_run("runs equal a nowhere", dir.path()).code, 66);
}

TEST(RunTruth, EveryNumberOfRunYamlIsOneToYaml11) {
  const TempDir dir;
  write_packed_config(dir, 1, 0);
  ASSERT_EQ(semfield_run("train config.yaml --threads 1 --out run --set train.adam.epsilon=1e-12", dir.path()).code, 0);
  const std::string yaml = read_text_file(dir / "run/run.yaml");
  static const std::regex word(R"((?:: |\[|, )([-+.]?[0-9][^\s,\]]*))");
  static const std::regex number(R"([-+]?(?:0|[1-9][0-9]*)(?:\.[0-9]*(?:[eE][-+][0-9]+)?)?)");
  int seen = 0;
  for (std::sregex_iterator found(yaml.begin(), yaml.end(), word), end; found != end; ++found, ++seen)
    EXPECT_TRUE(std::regex_match((*found)[1].str(), number)) << (*found)[1];
  EXPECT_GT(seen, 40);
  EXPECT_HAS(yaml, "epsilon: 1.0e-12");
}

// What helps a run over a step that fails may change; the remedy of such a step says so.
TEST(RunTruth, AResumeMayTakeAnotherSeedOrLearningRate) {
  const TempDir dir;
  write_packed_config(dir, 3, 0);
  ASSERT_EQ(semfield_run("train config.yaml --threads 1 --out run", dir.path()).code, 0);
  const Result r = semfield_run(
      "train --resume run --steps 5 --set runtime.seed=4 --set train.adam.learning_rate=0.001", dir.path());
  EXPECT_EQ(r.code, 0) << r.err;
  EXPECT_HAS(r.err, "from step 3 on: runtime.seed: 1 -> 4");
  EXPECT_EQ(semfield_run("train --resume run --steps 6", dir.path()).code, 0) << "and it stays so";
}

}  // namespace
}  // namespace semfield
