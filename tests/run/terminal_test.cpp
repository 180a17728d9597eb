// What long work says of itself, the live line's width, and notes of whole words; on a real terminal: process_test.py.
#include "app/terminal.h"

#include "tests/says.h"

namespace semfield {
namespace {

using namespace app;

// One line on a terminal, one every two seconds elsewhere, none when quiet.

// Everything written while `done` goes from 0 to 4 frames, a second each, shown at every half.
std::string written(bool terminal, bool quiet, double second = 1, int columns = 80) {
  AppContext context;
  context.terminal = terminal;
  context.quiet = quiet;
  double now_s = 100;
  std::string out;
  {
    ProgressLine line(
        context, "scored", "frames",
        {[&] { return now_s; }, [&](const std::string& text) { out += terminal ? "<" + text + ">" : text + "\n"; },
         [=] { return columns; }});
    for (int half = 1; half <= 8; ++half) {
      now_s += second / 2;
      line.show(half / 2.0, 4);
    }
  }
  return out;
}

TEST(ProgressLine, ALineEveryTwoSecondsWhereLinesStay) {
  EXPECT_EQ(written(false, false), "scored 2/4 frames, 0:02 left\nscored 4/4 frames\n");
  EXPECT_EQ(written(false, false, 0.4), "") << "short work leaves no line";
  EXPECT_EQ(written(false, false, 60).substr(0, 29), "scored 0/4 frames, 3:30 left\n");
}

TEST(ProgressLine, ANewPartHasAUnitOfItsOwn) {
  double now_s = 0;
  std::string out;
  AppContext context;
  ProgressLine line(context, "seen", "frames",
                    {[&] { return now_s; }, [&](const std::string& text) { out += text + "\n"; }});
  line.restart("learned", "steps");
  now_s += 2;
  line.show(5, 10);
  EXPECT_EQ(out, "learned 5/10 steps, 0:02 left\n");
}

TEST(ProgressLine, ATerminalsLineIsOverwrittenAndCleared) {
  const std::string out = written(true, false);
  EXPECT_EQ(out.find('\n'), std::string::npos);
  EXPECT_EQ(out.find("<scored 0/4 frames, 0:04 left><scored 1/4 frames, 0:03 left>"), 0u) << out;
  EXPECT_HAS(out, "<scored 4/4 frames><>");
  EXPECT_EQ(written(true, false, 1, 23).find("<scored 0/4, 0:04 left><scored 1/4, 0:03 left>"), 0u);
  EXPECT_EQ(written(true, false, 1, 20).find("<scored 0/4><scored 1/4>"), 0u);
}

TEST(ProgressLine, QuietIsSilent) {
  EXPECT_EQ(written(false, true), "");
  EXPECT_EQ(written(true, true), "");
}

TEST(LiveLine, PartsGoByRankUntilTheRestFits) {
  const std::vector<LinePart> parts{{0, "step 5"}, {2, "  loss 1"}, {3, "  a 1"}, {3, "  b 2"}, {1, "  0:05 left"}};
  EXPECT_EQ(fitted(parts, 100), "step 5  loss 1  a 1  b 2  0:05 left");
  EXPECT_EQ(fitted(parts, 35), "step 5  loss 1  a 1  b 2  0:05 left");
  EXPECT_EQ(fitted(parts, 34), "step 5  loss 1  a 1  0:05 left");
  EXPECT_EQ(fitted(parts, 26), "step 5  loss 1  0:05 left");
  EXPECT_EQ(fitted(parts, 20), "step 5  0:05 left");
  EXPECT_EQ(fitted(parts, 16), "step 5");
  EXPECT_EQ(fitted(parts, 4), "step");
  EXPECT_EQ(fitted({{0, "Küche"}}, 5), "Küche") << "columns, not bytes";
  EXPECT_EQ(fitted({{0, "部屋の"}}, 5), "部屋") << "wide characters take two";
}

TEST(Notes, BreakBetweenWordsAndNeverInACommand) {
  EXPECT_EQ(wrapped("the length is settled", 80), "the length is settled");
  EXPECT_EQ(wrapped("the length is settled", 12), "the length\nis settled");
  EXPECT_EQ(wrapped("the length is settled", 10), "the length\nis settled");
  EXPECT_EQ(wrapped("go on with `semfield train --resume r`, or not", 20),
            "go on with\n`semfield train --resume r`,\nor not");
  EXPECT_EQ(wrapped("unbreakable/path/to/a/file is\n  indented", 8), "unbreakable/path/to/a/file\nis\n  indented");
  EXPECT_EQ(wrapped("a ` alone is no command", 9), "a ` alone\nis no\ncommand");
  EXPECT_EQ(wrapped("", 5), "");
  EXPECT_EQ(wrapped("f=aaa,bbb,ccc", 9), "f=aaa,\nbbb,ccc");
  EXPECT_EQ(wrapped("depth   a b c d e f\neval: a=1 b=2 c=3\n", 16, true),
            "depth   a b c d\n        e f\neval: a=1 b=2\n  c=3\n");
}

TEST(Notes, ColoursMarkWhatIsWrongAndWhatIsTyped) {
  EXPECT_EQ(painted("warning: dark [scene.a.dark]"), "\033[1;33mwarning\033[0m: dark \033[2m[scene.a.dark]\033[0m");
  EXPECT_EQ(painted("go `x --y`\n$ ls"), "go \033[1m`x --y`\033[0m\n\033[1m$ ls\033[0m");
  EXPECT_EQ(painted("next\n  # why\n"), "\033[1mnext\033[0m\n  \033[2m# why\033[0m\n");
  EXPECT_EQ(painted("a warning, [1, 2] and #5 in [a.py:3]"), "a warning, [1, 2] and #5 in [a.py:3]");
}

}  // namespace
}  // namespace semfield
