#include "session/settings/pace.h"

#include <algorithm>
#include <cmath>

namespace semfield {

namespace {

constexpr double kShare = 1.0 / 40;                // of the time between two marks
constexpr std::size_t kMarks = 5;                  // a tenth of the time lies between the first and the last
constexpr double kEarliest = 0.1, kLatest = 0.25;  // of the time, when the number of steps is settled
constexpr double kStill = 0.05;                    // change of the rate between two shares that counts as none
constexpr double kMissed = 1.0 / 12;               // of the time, by which the end may miss it
constexpr double kLast = 0.1;                      // of the time at the end, in which nothing is settled anew

}  // namespace

Pace::Pace(double begin_s, double until_s)
    : begin_s_(begin_s), until_s_(until_s), share_s_((until_s - begin_s) * kShare), settled_{begin_s, 0} {}

double Pace::steps_per_s() const {
  if (marks_.size() < 2) return 0;
  const Mark &first = marks_.front(), &last = marks_.back();
  return static_cast<double>(last.step - first.step) / std::max(last.s - first.s, 1e-9);
}

bool Pace::still() const {
  if (marks_.size() < kMarks) return false;
  const auto rate = [&](std::size_t from, std::size_t to) {
    return static_cast<double>(marks_[to].step - marks_[from].step) / std::max(marks_[to].s - marks_[from].s, 1e-9);
  };
  const double before = rate(0, kMarks / 2), now = rate(kMarks / 2, kMarks - 1);
  return std::abs(now - before) <= kStill * before;
}

std::int64_t Pace::end_at_this_rate() const {
  const double left = std::max(0.0, until_s_ - marks_.back().s) * steps_per_s();
  return marks_.back().step + std::llround(left);
}

// Seconds; above 0: the end comes too late.
double Pace::misses_by(double rate, std::int64_t end) const {
  return marks_.back().s + static_cast<double>(end - marks_.back().step) / std::max(rate, 1e-9) - until_s_;
}

std::optional<std::int64_t> Pace::made(std::int64_t step, double train_s, std::int64_t end) {
  const double time_s = until_s_ - begin_s_;
  if (end == 0 && train_s >= until_s_) return step;
  if (!marks_.empty() && train_s - marks_.back().s < share_s_) return std::nullopt;
  marks_.push_back({train_s, step});
  if (marks_.size() > kMarks) marks_.pop_front();
  const double used_s = train_s - begin_s_;
  if (end == 0) {
    const bool due = used_s >= kEarliest * time_s && (still() || used_s >= kLatest * time_s);
    if (!due || marks_.size() < 2) return std::nullopt;
    settled_ = marks_.back();
    return end_at_this_rate();
  }
  const bool measured = marks_.size() == kMarks && marks_.front().s >= settled_.s;
  if (!measured || step >= end || until_s_ - train_s < kLast * time_s) return std::nullopt;
  // Of the last tenth, and of all since it was settled: what passes within a moment moves the first alone.
  const double now = misses_by(steps_per_s(), end);
  const double since = misses_by(static_cast<double>(step - settled_.step) / (train_s - settled_.s), end);
  if (std::abs(now) <= kMissed * time_s || now * since <= 0 || std::abs(since) <= 0.5 * kMissed * time_s)
    return std::nullopt;
  settled_ = marks_.back();
  return end_at_this_rate();
}

}  // namespace semfield
