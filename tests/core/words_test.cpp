// Words, lines and numbers of text files.
#include "core/words.h"

#include <gtest/gtest.h>

#include <cmath>

namespace semfield {
namespace {

TEST(Words, AnyBlanksSeparate) {
  EXPECT_EQ(words_of("  a\tbc  d \r"), (std::vector<std::string_view>{"a", "bc", "d"}));
  EXPECT_TRUE(words_of(" \t").empty());
  EXPECT_TRUE(words_of("").empty());
}

TEST(Words, LinesWithEitherEnd) {
  std::string_view text = "a\r\n\nb c", line;
  std::vector<std::string_view> lines;
  while (next_line(text, line)) lines.push_back(line);
  EXPECT_EQ(lines, (std::vector<std::string_view>{"a", "", "b c"}));
}

TEST(Words, NumbersAreWholeWords) {
  double v = 7;
  EXPECT_TRUE(parse_number("-1.5e2", v));
  EXPECT_EQ(v, -150);
  EXPECT_TRUE(parse_number("+2", v));
  EXPECT_EQ(v, 2);
  EXPECT_TRUE(parse_number("-inf", v));
  EXPECT_EQ(v, -INFINITY);
  EXPECT_TRUE(parse_number("nan", v));
  EXPECT_TRUE(std::isnan(v));
  v = 7;
  for (const char* bad : {"", "x", "1x", "+-1", "1 ", "0x10", "1,5", "1e999"})
    EXPECT_FALSE(parse_number(bad, v)) << bad;
  EXPECT_EQ(v, 7);
}

}  // namespace
}  // namespace semfield
