// `semfield-study scale` through the program: one rank, several ranks where there is mpirun, and its mistakes.
#include <nlohmann/json.hpp>

#include "../program.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using nlohmann::json;
using testing_program::Result;

class ScaleVerb : public testing::Test {
 protected:
  Result run(const std::string& words, const std::string& before = "") const {
    return testing_program::semfield_run("scale " + words, folder_, before);
  }
  std::string file(const std::string& name) const { return read_text_file(folder_ + "/" + name); }
  bool has(const std::string& name) const { return fs::exists(folder_ + "/" + name); }
  const TempDir dir_;
  const std::string& folder_ = dir_.path();
};

std::string last_line(const std::string& text) {
  const std::size_t end = text.find_last_not_of('\n');
  const std::size_t begin = text.rfind('\n', end);
  return text.substr(begin + 1, end - begin);
}

TEST_F(ScaleVerb, OneRankNeedsNoLauncherAndSaysWhatItCannotMeasure) {
  const Result r = run("--quick --ranks 1 --repeats 1 --out kept", "PATH=/nowhere ");
  ASSERT_EQ(r.code, 0) << r.err;
  EXPECT_EQ(last_line(r.out),
            "scale: cpu2_strong=- cpu2_weak=- cpu16_strong=- gpu2_weak_paper=- gpu2_strong_paper4096=- "
            "gpu2_weak_hash=- bits_equal=yes sweep2=-");
  EXPECT_HAS(r.out, "not measured: sweep2: ");
  const json results = json::parse(file("kept/results.json"));
  ASSERT_GE(results["rows"].size(), 5U);
  for (const json& row : results["rows"]) {
    EXPECT_EQ(row["ranks"], 1);
    EXPECT_GT(row["seconds"]["min"], 0);
    EXPECT_LE(row["seconds"]["min"], row["seconds"]["median"]);
    EXPECT_GT(row["gradient_bytes"], 0);
    EXPECT_EQ(row["table_bytes"] > 0, row["step"] == "hash");
  }
  EXPECT_TRUE(has("kept/scale.md"));
  EXPECT_TRUE(has("kept/scale.svg"));
  EXPECT_FALSE(has("kept/work"));
}

TEST_F(ScaleVerb, WithoutALauncherThePackageIsNamed) {
  const Result r = run("--quick", "PATH=/nowhere ");
  EXPECT_EQ(r.code, 69);
  EXPECT_HAS(r.err, "mpirun", "openmpi-bin");
}

TEST_F(ScaleVerb, AsARankItIsRefused) {
  const Result r = run("--quick",
                       "OMPI_COMM_WORLD_RANK=0 OMPI_COMM_WORLD_SIZE=2 OMPI_COMM_WORLD_LOCAL_RANK=0 "
                       "OMPI_COMM_WORLD_LOCAL_SIZE=2 ");
  EXPECT_EQ(r.code, 2);
  EXPECT_HAS(r.err, "works in one");
}

TEST_F(ScaleVerb, FiguresOfOthersAreCombined) {
  ASSERT_EQ(run("--quick --ranks 1 --repeats 1 --only cpu --out a").code, 0);
  const Result again = run("--json --combine a/results.json --out b");
  ASSERT_EQ(again.code, 0) << again.err;
  EXPECT_EQ(file("a/results.json"), file("b/results.json"));
  EXPECT_EQ(json::parse(again.out)["rows"], json::parse(file("a/results.json"))["rows"]);
  EXPECT_EQ(run("--combine a/results.json --write-docs .").code, 2);  // narrow networks
  EXPECT_EQ(run("--combine nothing.json").code, 66);
}

TEST_F(ScaleVerb, WrongWordsAreRefused) {
  EXPECT_EQ(run("--ranks 0").code, 2);
  EXPECT_EQ(run("--only cpus").code, 2);
  EXPECT_EQ(run("--repeats 0").code, 2);
}

}  // namespace
}  // namespace semfield
