// A save killed before, in and after every one of its file calls: a fresh process finds the old or the new, whole.
#include <gtest/gtest.h>

#include <cstdio>
#include <filesystem>

#include "tests/crash/victim_runs.h"

namespace semfield::testing_crash {
namespace {

class Kill : public ::testing::TestWithParam<Save> {};

TEST_P(Kill, AtEveryCallLeavesTheOldOrTheNewWhole) {
  const Undisturbed& u = undisturbed(GetParam());
  int kills = 0, found_old = 0, found_new = 0, stale = 0;
  for (const FileCall& call : u.calls) {
    for (const char* kind : {"kill_before", "kill_half", "kill_after"}) {
      if (std::string(kind) == "kill_half" && (call.name != "write" || call.size < 2)) continue;
      const std::string place = std::string(kind) + " " + call.name + " " + call.path + ", call " +
                                std::to_string(call.number) + " of " + std::to_string(u.calls.size());
      Trial trial(GetParam());
      const testing_program::Result r = trial.save({call.number, kind, false});
      ASSERT_EQ(r.signal, SIGKILL) << place;
      ++kills;
      for (const auto& entry : std::filesystem::recursive_directory_iterator(trial.folder()))
        stale += entry.path().extension() == ".tmp" ? 1 : 0;
      const Look found = trial.look();
      EXPECT_EQ(found.bad, "") << place;
      EXPECT_EQ(found.temporaries, 0) << place;
      EXPECT_TRUE(found.crc == u.old_crc || found.crc == u.new_crc) << place;
      (found.crc == u.old_crc ? found_old : found_new) += 1;
      // The same save again, by a next process, ends as if nothing had been.
      const testing_program::Result again = trial.save();
      EXPECT_EQ(again.code, 0) << place << ": " << again.err;
      EXPECT_EQ(trial.look().crc, u.new_crc) << place;
    }
  }
  EXPECT_GT(found_old, 0);
  EXPECT_GT(found_new, 0);
  EXPECT_GT(stale, 0) << "no kill left a temporary file, so their removal was not tried";
  std::printf("%s: %zu calls, %d kills, %d found the old, %d the new, %d left a temporary file\n", name_of(GetParam()),
              u.calls.size(), kills, found_old, found_new, stale);
}

std::string param_name(const ::testing::TestParamInfo<Save>& info) { return name_of(info.param); }
INSTANTIATE_TEST_SUITE_P(EverySave, Kill, ::testing::ValuesIn(kSaves), param_name);

}  // namespace
}  // namespace semfield::testing_crash
