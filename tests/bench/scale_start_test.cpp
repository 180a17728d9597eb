// What `semfield-study scale` makes of ranks that cannot be had, and of trainings that fail.
#include <algorithm>

#include "../program.h"
#include "core/error.h"
#include "core/text.h"
#include "studies/scale_bench.h"
#include "studies/scale_page.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

// Trainings on one rank run; those on more end with `code_of_ranks`.
class ScaleStarts : public testing::Test {
 protected:
  ScaleResults measure(std::vector<std::string> only, int code_of_ranks, int cores = 2) {
    const StudyTools study{registry_, [](const std::string&) {},
                           [](const std::string& path) { return SEMFIELD_SOURCE_DIR "/" + path; }};
    const auto start_one = [&](const ScaleStart& start) -> ScaleEnd {
      started_.push_back(start);
      if (start.ranks > 1) return {code_of_ranks, "this build has no MPI", 1};
      std::string words;
      for (const std::string& word : start.words) words += shell_word(word) + " ";
      if (other_seed_on_two_threads_ && read_text_file(start.words[1]).find("\"threads\": 2") != std::string::npos)
        words += "--set runtime.seed=7";
      const testing_program::Result r = testing_program::semfield_run(words, folder_);
      return {r.code, r.err, 2};
    };
    ScaleBenchOptions options;
    options.only = std::move(only);
    options.quick = true;
    options.repeats = 1;
    return measure_scale(options, {study, folder_, cores, [&] { ++asked_; }, start_one});
  }
  bool says(const ScaleResults& results, const std::string& text) const {
    return std::any_of(results.missing.begin(), results.missing.end(),
                       [&](const std::string& line) { return line.find(text) != std::string::npos; });
  }

  Registry registry_;
  const TempDir dir_;
  const std::string& folder_ = dir_.path();
  std::vector<ScaleStart> started_;
  int asked_ = 0;  // for a launcher
  bool other_seed_on_two_threads_ = false;
};

TEST_F(ScaleStarts, RanksThatCannotBeHadAreToldOnceAndTheRestIsMeasured) {
  const ScaleResults results = measure({"cpu", "bits", "sweep"}, static_cast<int>(ErrorKind::unavailable));
  EXPECT_GE(asked_, 1);
  EXPECT_TRUE(says(results, "this build has no MPI"));
  EXPECT_TRUE(says(results, "sweep2"));
  EXPECT_EQ(std::count_if(started_.begin(), started_.end(), [](const ScaleStart& s) { return s.ranks > 1; }), 1);
  EXPECT_GE(results.rows.size(), 5U);
  for (const ScaleRow& row : results.rows) EXPECT_EQ(row.ranks, 1);
  EXPECT_EQ(scale_line(results),
            "scale: cpu2_strong=- cpu2_weak=- cpu16_strong=- gpu2_weak_paper=- gpu2_strong_paper4096=- "
            "gpu2_weak_hash=- bits_equal=yes sweep2=-");
}

TEST_F(ScaleStarts, ATrainingThatFailsEndsTheStudyWithWhatItSaid) {
  EXPECT_HAS(error_of(ErrorKind::failure, [&] { measure({"cpu"}, static_cast<int>(ErrorKind::failure)); }),
             "paper step of 32 rays on 2 ranks failed: this build has no MPI");
}

TEST_F(ScaleStarts, ATrainingThatEndsInOtherBitsIsFound) {
  other_seed_on_two_threads_ = true;
  const ScaleResults results = measure({"bits"}, static_cast<int>(ErrorKind::unavailable));
  ASSERT_GE(results.bits.size(), 2U);
  EXPECT_EQ(results.bits[0].difference, "");
  EXPECT_EQ(results.bits[1].threads, 2);
  EXPECT_NE(results.bits[1].difference, "");
  EXPECT_HAS(scale_line(results), "bits_equal=no");
}

TEST_F(ScaleStarts, OneThreadOnEachOfManyPinnedRanks) {
  measure({"cpu"}, static_cast<int>(ErrorKind::unavailable), 1);
  EXPECT_EQ(asked_, 0);  // one core, so nothing calls for several ranks
  ASSERT_FALSE(started_.empty());
  for (const ScaleStart& start : started_) {
    EXPECT_EQ(start.ranks, 1);
    EXPECT_TRUE(start.pinned);
    ASSERT_EQ(start.words.front(), "train");
    const std::string config = read_text_file(start.words[1]);
    EXPECT_HAS(config, "\"threads\": 1");
  }
}

}  // namespace
}  // namespace semfield
