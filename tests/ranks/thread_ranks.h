// Ranks that are threads of one process: what several processes do together, tested without a launcher.
#pragma once

#include <algorithm>
#include <chrono>
#include <condition_variable>
#include <cstring>
#include <deque>
#include <map>
#include <mutex>
#include <thread>

#include "core/check.h"
#include "execution/ranks/ranks.h"

namespace semfield::testing {

/// Where the threads meet. Who waits for a rank that has ended, or longer than any test takes, gets RankLost; a rank
/// that failed ends the waiting of all.
class ThreadMeeting {
 public:
  explicit ThreadMeeting(int size) : shown_(static_cast<std::size_t>(size)), ended_(shown_.size()) {
    for (int r = 0; r < size; ++r) names_.push_back("rank " + std::to_string(r) + " of this test");
  }
  int size() const { return static_cast<int>(shown_.size()); }
  const std::string& name_of(int rank) const { return names_.at(static_cast<std::size_t>(rank)); }

  /// Every rank shows its data; `use` sees everybody's, and nobody's are taken back before all have seen them.
  template <class Use>
  void meet(int rank, std::span<const std::byte> data, const Use& use) {
    {
      const std::lock_guard lock(mutex_);
      shown_[rank] = data;
    }
    wait_for_all();
    use(shown_);
    wait_for_all();
  }
  void put(int from, int to, std::span<const std::byte> data) {
    const std::lock_guard lock(mutex_);
    letters_[{from, to}].emplace_back(data.begin(), data.end());
    changed_.notify_all();
  }
  std::vector<std::byte> take(int from, int to) {
    std::unique_lock lock(mutex_);
    std::deque<std::vector<std::byte>>& box = letters_[{from, to}];
    wait(
        lock, [&] { return !box.empty(); }, [&] { return ended_[from]; });
    std::vector<std::byte> letter = std::move(box.front());
    box.pop_front();
    return letter;
  }
  /// Throws where a rank has ended.
  void look() {
    const std::lock_guard lock(mutex_);
    if (!lost_.empty()) throw RankLost(ErrorKind::failure, "test.error.made", lost_, "");
  }
  void end(int rank, bool failed) {
    const std::lock_guard lock(mutex_);
    ended_[rank] = true;
    if (lost_.empty()) lost_ = name_of(rank) + " has ended";
    failed_ = failed_ || failed;
    changed_.notify_all();
  }

 private:
  template <class Ready, class Hopeless>
  void wait(std::unique_lock<std::mutex>& lock, const Ready& ready, const Hopeless& hopeless) {
    constexpr std::chrono::minutes kLongest{5};
    const bool in_time = changed_.wait_for(lock, kLongest, [&] { return ready() || failed_ || hopeless(); });
    if (ready()) return;
    throw RankLost(ErrorKind::failure, "test.error.made", in_time ? lost_ : "a rank of this test does not answer", "");
  }
  void wait_for_all() {
    std::unique_lock lock(mutex_);
    const std::uint64_t round = round_;
    if (++arrived_ == size()) {
      arrived_ = 0;
      ++round_;
      changed_.notify_all();
      return;
    }
    wait(
        lock, [&] { return round_ != round; },
        [&] { return std::find(ended_.begin(), ended_.end(), true) != ended_.end(); });
  }

  std::mutex mutex_;
  std::condition_variable changed_;
  std::vector<std::span<const std::byte>> shown_;
  std::vector<bool> ended_;
  std::map<std::pair<int, int>, std::deque<std::vector<std::byte>>> letters_;
  std::vector<std::string> names_;
  bool failed_ = false;  // some rank ended by an error
  std::string lost_;     // who ended first
  int arrived_ = 0;
  std::uint64_t round_ = 0;
};

class ThreadRanks final : public Ranks {
 public:
  ThreadRanks(ThreadMeeting& meeting, int rank) : meeting_(meeting), rank_(rank) {}

  int rank() const override { return rank_; }
  int size() const override { return meeting_.size(); }
  const std::string& name_of(int rank) const override { return meeting_.name_of(rank); }
  int local_rank() const override { return rank_; }
  int local_size() const override { return size(); }

  void broadcast(std::span<std::byte> data, int root = 0) override {
    call([&] {
      meeting_.meet(rank_, data, [&](const auto& shown) {
        if (rank_ != root) copy(shown[root], data);
      });
    });
  }
  void all_gather(std::span<const std::byte> mine, std::span<std::byte> all,
                  std::span<const std::size_t> bytes) override {
    call([&] { meeting_.meet(rank_, mine, [&](const auto& shown) { put_together(shown, all, bytes); }); });
  }
  void send(int to, std::span<const std::byte> data) override { meeting_.put(rank_, to, data); }
  void receive(int from, std::span<std::byte> data) override {
    call([&] {
      const std::vector<std::byte> letter = meeting_.take(from, rank_);
      copy(letter, data);
    });
  }
  void end_when(std::function<bool()>, std::function<void()>) override {}
  void watch() override {
    call([&] { meeting_.look(); });
  }
  bool lost() const override { return lost_; }
  void abandon(int) override { meeting_.end(rank_, true); }

 private:
  template <class Work>
  void call(const Work& work) {
    try {
      work();
    } catch (const RankLost&) {
      lost_ = true;
      throw;
    }
  }
  static void copy(std::span<const std::byte> from, std::span<std::byte> to) {
    SEMFIELD_CHECK(from.size() == to.size(), "ranks disagree about the size of what they exchange");
    if (!from.empty()) std::memcpy(to.data(), from.data(), from.size());
  }
  static void put_together(const std::vector<std::span<const std::byte>>& shown, std::span<std::byte> all,
                           std::span<const std::size_t> bytes) {
    std::size_t at = 0;
    for (std::size_t r = 0; r < shown.size(); ++r) {
      copy(shown[r], all.subspan(at, bytes[r]));
      at += bytes[r];
    }
    SEMFIELD_CHECK(at == all.size(), "ranks disagree about the size of what they exchange");
  }

  ThreadMeeting& meeting_;
  int rank_;
  bool lost_ = false;
};

/// Calls `body` as every one of `size` ranks at the same time. Throws what the first of them threw that did not merely
/// lose another.
inline void as_ranks(int size, const std::function<void(Ranks&)>& body) {
  ThreadMeeting meeting(size);
  std::vector<std::exception_ptr> thrown(static_cast<std::size_t>(size)), losses(thrown.size());
  std::vector<std::thread> threads;
  for (int r = 0; r < size; ++r) {
    threads.emplace_back([&, r] {
      ThreadRanks ranks(meeting, r);
      try {
        body(ranks);
        meeting.end(r, false);
        return;
      } catch (const RankLost&) {
        losses[r] = std::current_exception();
      } catch (...) {
        thrown[r] = std::current_exception();
      }
      meeting.end(r, true);
    });
  }
  for (std::thread& thread : threads) thread.join();
  thrown.insert(thrown.end(), losses.begin(), losses.end());
  for (const std::exception_ptr& one : thrown) {
    if (one) std::rethrow_exception(one);
  }
}

}  // namespace semfield::testing
