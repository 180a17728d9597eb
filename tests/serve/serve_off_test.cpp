// A build without the labelling page says so.
#include "tests/program.h"

namespace semfield {
namespace {

TEST(ServeOff, TheVerbNamesThePackagesThatItNeeds) {
  const std::string folder = ::testing::TempDir();
  const testing_program::Result r =
      testing_program::Process(testing_program::program(), {"serve", "room.yaml"}, folder).wait();
  EXPECT_EQ(r.code, 69);
  EXPECT_EQ(r.err,
            "semfield: this build has no labelling page; build with -DSEMFIELD_WITH_SERVE=ON, which needs the package "
            "libturbojpeg0-dev [serve.page.missing]\n");
}

}  // namespace
}  // namespace semfield
