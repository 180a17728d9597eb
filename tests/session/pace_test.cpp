// The number of steps that fits into a time, settled from the rate of the steps; seconds are counted, never read.
#include "settings/pace.h"

#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <ostream>
#include <string>

namespace semfield {
namespace {

struct Course {
  double trained_s = 0;
  std::int64_t steps = 0;
  double first_settled_s = 0;
  int settled = 0;
};

/// Steps one after the other, `queued` at a time; step i takes `seconds(i, s)` after s seconds of training.
Course train(double begin_s, double until_s, int queued, const std::function<double(std::int64_t, double)>& seconds) {
  Pace pace(begin_s, until_s);
  Course course;
  std::int64_t step = 0, end = 0;
  double now_s = begin_s;
  while (end == 0 || step < end) {
    for (int i = 0; i < queued && (end == 0 || step < end); ++i) now_s += seconds(step++, now_s);
    if (const auto settled = pace.made(step, now_s, end)) {
      EXPECT_GE(*settled, step);
      end = *settled;
      if (course.settled++ == 0) course.first_settled_s = now_s - begin_s;
    }
  }
  course.trained_s = now_s - begin_s;
  course.steps = step;
  return course;
}

TEST(Pace, EqualStepsAreSettledOnceAfterATenthOfTheTime) {
  const Course course = train(0, 20, 1, [](std::int64_t, double) { return 0.05; });
  EXPECT_EQ(course.settled, 1);
  EXPECT_NEAR(course.first_settled_s, 2, 0.6);
  EXPECT_NEAR(course.trained_s, 20, 0.1);
  EXPECT_EQ(course.steps, 400);
}

TEST(Pace, ALegThatBeginsLaterHasItsOwnTime) {
  const Course course = train(100, 110, 1, [](std::int64_t, double) { return 0.02; });
  EXPECT_NEAR(course.first_settled_s, 1, 0.3);
  EXPECT_NEAR(course.trained_s, 10, 0.1);
}

struct Machine {
  const char* name;
  double time_s;
  int queued, most_settled;
  std::function<double(std::int64_t, double)> seconds;
};

void PrintTo(const Machine& machine, std::ostream* out) { *out << machine.name; }

class PaceOn : public ::testing::TestWithParam<Machine> {};

TEST_P(PaceOn, TheTimeIsMetWithinATenth) {
  const Machine& machine = GetParam();
  const Course course = train(0, machine.time_s, machine.queued, machine.seconds);
  EXPECT_NEAR(course.trained_s, machine.time_s, 0.1 * machine.time_s) << course.settled << " times settled";
  EXPECT_LE(course.first_settled_s, 0.3 * machine.time_s);
  EXPECT_LE(course.settled, machine.most_settled);
}

double noise(std::int64_t step) { return 0.5 + 0.5 * std::sin(static_cast<double>(step * step % 1009)); }

const Machine kMachines[] = {
    // Space empties: a step takes a third of its time in the end.
    {"two_cores", 20, 1, 6,
     [](std::int64_t i, double) { return 0.02 + 0.04 * std::exp(-static_cast<double>(i) / 300); }},
    {"two_cores_for_long", 300, 1, 5,
     [](std::int64_t i, double) { return 0.02 + 0.04 * std::exp(-static_cast<double>(i) / 300); }},
    {"loaded_cores", 20, 1, 2, [](std::int64_t i, double) { return 0.03 + 0.06 * noise(i); }},
    {"load_that_ends", 300, 1, 4, [](std::int64_t, double s) { return s < 120 ? 0.06 : 0.02; }},
    {"load_that_comes", 300, 1, 4, [](std::int64_t, double s) { return s < 120 ? 0.02 : 0.06; }},
    {"load_that_comes_and_goes", 300, 1, 8, [](std::int64_t, double s) { return std::fmod(s, 50) < 25 ? 0.02 : 0.05; }},
    {"gpu", 20, 32, 2, [](std::int64_t i, double) { return i < 4 ? 0.4 : 2.4e-4 + 2e-4 * noise(i); }},
    // It passes, and moves nothing.
    {"a_stall", 20, 1, 1, [](std::int64_t i, double) { return i == 200 ? 0.35 : 0.05; }},
    {"slow_first_step", 10, 1, 2, [](std::int64_t i, double) { return i == 0 ? 2.0 : 0.01; }},
};
INSTANTIATE_TEST_SUITE_P(Machines, PaceOn, ::testing::ValuesIn(kMachines),
                         [](const ::testing::TestParamInfo<Machine>& row) { return row.param.name; });

TEST(Pace, StepsThatTakeMostOfTheTimeEndNearIt) {
  EXPECT_EQ(train(0, 10, 1, [](std::int64_t, double) { return 4.0; }).steps, 3) << "8 s, and 2 s are half a step";
  EXPECT_EQ(train(0, 10, 1, [](std::int64_t, double) { return 60.0; }).steps, 1);
}

TEST(Pace, TheRateIsThatOfTheLastTenth) {
  Pace pace(0, 100);
  EXPECT_EQ(pace.steps_per_s(), 0);
  std::int64_t step = 0;
  double now_s = 0;
  while (now_s < 30) {
    now_s += now_s < 12 ? 1 : 0.25;
    (void)pace.made(++step, now_s, 1000);
  }
  EXPECT_NEAR(pace.steps_per_s(), 4, 1e-9);
}

}  // namespace
}  // namespace semfield
