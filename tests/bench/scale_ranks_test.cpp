// `semfield-study scale` with real ranks of mpirun.
#include <nlohmann/json.hpp>

#include "../program.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

using nlohmann::json;

TEST(ScaleRanks, TwoRanksAreTimedAndEndInTheBitsOfOne) {
  const TempDir dir;
  const testing_program::Result r =
      testing_program::semfield_run("scale --quick --repeats 1 --only cpu,bits,sweep --json", dir.path());
  ASSERT_EQ(r.code, 0) << r.err;
  const json out = json::parse(r.out);
  const int cores = out["machines"][0]["units"];
  int timed = 0, compared = 0;
  for (const json& row : out["rows"]) timed += row["ranks"] == 2 ? 1 : 0;
  for (const json& row : out["bits"]) {
    EXPECT_EQ(row["difference"], "") << row.dump();
    compared += row["ranks"] == 2 ? 1 : 0;
  }
  EXPECT_EQ(timed > 0, cores >= 2) << out.dump(1);
  EXPECT_GT(compared, 0) << out.dump(1);
  EXPECT_EQ(out["goals"]["bits_equal"], "yes");
  if (cores < 2) return;
  for (const char* goal : {"cpu2_strong", "cpu2_weak", "sweep2"}) {
    const double times = std::stod(out["goals"][goal].get<std::string>());
    EXPECT_GT(times, 0) << goal;
  }
}

}  // namespace
}  // namespace semfield
