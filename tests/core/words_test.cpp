// Words, lines and numbers of text files.
#include <gtest/gtest.h>

#include <cmath>
#include <cstdio>

#include "core/text.h"

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

TEST(Words, CharactersOfUtf8) {
  const std::string_view text = "a\xC3\xA9\xE2\x82\xAC\xF0\x9F\x98\x80";
  EXPECT_EQ(utf8_length(text, 0), 1u);
  EXPECT_EQ(utf8_length(text, 1), 2u);
  EXPECT_EQ(utf8_length(text, 3), 3u);
  EXPECT_EQ(utf8_length(text, 6), 4u);
  for (const char* bad : {"\x96", "\xC3", "\xC0\xAF", "\xED\xA0\x80", "\xF5\x80\x80\x80"})
    EXPECT_EQ(utf8_length(bad, 0), 0u);
}

TEST(Words, AShellReadsAShellWordAsTheText) {
  EXPECT_EQ(shell_word("runs/room_2,a=b"), "runs/room_2,a=b");
  EXPECT_EQ(shell_word(""), "''");
  for (const std::string text : {"a b's", "it's", "$HOME `id` \"x\" \\ !", "*", "~", "a\nb", "-x y", "\xC3\xA9"}) {
    FILE* const shell = popen(("printf %s " + shell_word(text)).c_str(), "r");
    std::string read;
    for (int c = std::fgetc(shell); c != EOF; c = std::fgetc(shell)) read += static_cast<char>(c);
    EXPECT_EQ(pclose(shell), 0);
    EXPECT_EQ(read, text);
  }
}

}  // namespace
}  // namespace semfield
