// What long work says of itself: one line on a terminal, one every two seconds elsewhere, none when quiet.
#include "app/progress_line.h"

#include <gtest/gtest.h>

namespace semfield::app {
namespace {

// Everything written while `done` goes from 0 to 4 frames, a second each, shown at every half.
std::string written(bool terminal, bool quiet, double second = 1) {
  AppContext context;
  context.terminal = terminal;
  context.quiet = quiet;
  double now_s = 100;
  std::string out;
  {
    ProgressLine line(context, "scored", "frames",
                      {[&] { return now_s; }, [&](const std::string& text) { out += text; }});
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

TEST(ProgressLine, ATerminalsLineIsOverwrittenAndCleared) {
  const std::string out = written(true, false);
  EXPECT_EQ(out.find('\n'), std::string::npos);
  EXPECT_EQ(out.find("\r\033[Kscored 0/4 frames, 0:04 left\r\033[Kscored 1/4 frames, 0:03 left"), 0u) << out;
  EXPECT_NE(out.find("\r\033[Kscored 4/4 frames\r\033[K"), std::string::npos) << out;
}

TEST(ProgressLine, QuietIsSilent) {
  EXPECT_EQ(written(false, true), "");
  EXPECT_EQ(written(true, true), "");
}

}  // namespace
}  // namespace semfield::app
