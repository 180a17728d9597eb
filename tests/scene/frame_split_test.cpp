// Which frames are held out.
#include "scene/frame_split.h"

#include <gtest/gtest.h>

#include <string>

namespace semfield {
namespace {

std::string splits(HoldOut rule, std::size_t frames) {
  std::string out;
  for (std::size_t i = 0; i < frames; ++i) out += rule.split_of(i, frames) == Split::test ? 'T' : '.';
  return out;
}

TEST(HoldOut, EveryNthFromTheFirst) {
  EXPECT_EQ(splits({8}, 10), "T.......T.");
  EXPECT_EQ(splits({2, 1}, 5), ".T.T.");
  EXPECT_EQ(splits({0}, 3), "...");
  EXPECT_EQ(splits({0, -1}, 3), "...");
  EXPECT_EQ(splits({8}, 1), ".");
}

TEST(HoldOut, OneInOneIsRefused) {
  Diagnostics d;
  check_test_every(1, d);
  ASSERT_EQ(d.error_count(), 1);
  EXPECT_EQ(d.all()[0].text(), "test_every: 1 leaves no frame to train on; take 2 or more, or 0 for no test frames");
  check_test_every(0, d);
  check_test_every(2, d);
  EXPECT_EQ(d.error_count(), 1);
}

}  // namespace
}  // namespace semfield
