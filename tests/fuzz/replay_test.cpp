// Every kept input of the fuzzers - the seeds and what was once found - through its target, whole, cut short and with
// bytes changed. The compiler is that of the build, the fuzzers' is another.
#include <gtest/gtest.h>

#include <algorithm>
#include <ostream>

#include "core/files.h"
#include "tests/fuzz/targets.h"

namespace semfield::fuzz {

// In names of tests, in place of bytes.
void PrintTo(const Target& target, std::ostream* out) { *out << target.name; }

namespace {

std::vector<fs::path> inputs_of(std::string_view kind, std::string_view target) {
  std::vector<fs::path> out;
  const fs::path folder = fs::path(SEMFIELD_SOURCE_DIR) / "tests/fuzz" / kind / target;
  if (!fs::is_directory(folder)) return out;
  for (const fs::directory_entry& entry : fs::directory_iterator(folder)) out.push_back(entry.path());
  std::sort(out.begin(), out.end());
  return out;
}

class FuzzReplay : public ::testing::TestWithParam<Target> {};

TEST_P(FuzzReplay, KeptInputsBreakNoPromise) {
  const std::vector<fs::path> seeds = inputs_of("corpus", GetParam().name);
  ASSERT_FALSE(seeds.empty()) << "no seeds";
  std::vector<fs::path> all = inputs_of("regressions", GetParam().name);
  all.insert(all.end(), seeds.begin(), seeds.end());
  constexpr std::size_t kCuts = 16, kSpots = 64;
  constexpr std::string_view kOthers = "\"-9[x,\xFF";
  for (const fs::path& path : all) {
    SCOPED_TRACE(path.string());
    const std::string bytes = read_text_file(path.string());
    EXPECT_NO_THROW(GetParam().run(bytes));
    for (std::size_t cut = 0; cut < kCuts; ++cut)
      EXPECT_NO_THROW(GetParam().run(bytes.substr(0, bytes.size() * cut / kCuts))) << "first " << cut << "/16";
    for (std::size_t spot = 0; spot < kSpots && !bytes.empty(); ++spot) {
      std::string changed = bytes;
      const std::size_t at = bytes.size() * spot / kSpots;
      changed[at] = kOthers[spot % kOthers.size()];
      EXPECT_NO_THROW(GetParam().run(changed)) << "byte " << at << " is " << static_cast<int>(changed[at]);
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Targets, FuzzReplay, ::testing::ValuesIn(targets().begin(), targets().end()),
                         [](const auto& each) { return std::string(each.param.name); });

// Folders of inputs that no target reads would be replayed by nobody.
TEST(FuzzFolders, EveryFolderBelongsToATarget) {
  for (const char* kind : {"corpus", "regressions"}) {
    for (const fs::directory_entry& entry : fs::directory_iterator(fs::path(SEMFIELD_SOURCE_DIR) / "tests/fuzz" / kind))
      EXPECT_NE(find_target(entry.path().filename().string()), nullptr) << entry.path();
  }
}

}  // namespace
}  // namespace semfield::fuzz
