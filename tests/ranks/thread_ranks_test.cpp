// Ranks that are threads: what tests of several ranks rely on.
#include "tests/ranks/thread_ranks.h"

#include <gtest/gtest.h>

namespace semfield {
namespace {

using testing::as_ranks;

std::vector<std::byte> bytes_of(const std::string& text) {
  const auto all = std::as_bytes(std::span(text));
  return {all.begin(), all.end()};
}
std::string text_of(std::span<const std::byte> bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

TEST(ThreadRanks, EveryCallBringsWhatItSays) {
  as_ranks(3, [](Ranks& ranks) {
    ASSERT_EQ(ranks.size(), 3);
    const std::string mine(static_cast<std::size_t>(ranks.rank()), static_cast<char>('a' + ranks.rank()));
    EXPECT_EQ(texts_of(ranks, mine), (std::vector<std::string>{"", "b", "cc"}));
    std::vector<std::byte> data = bytes_of(ranks.rank() == 2 ? "xyz" : "...");
    ranks.broadcast(data, 2);
    EXPECT_EQ(text_of(data), "xyz");
    std::vector<std::byte> all(3);
    const std::size_t sizes[] = {0, 1, 2};
    ranks.gather(bytes_of(mine), all, sizes);
    EXPECT_EQ(text_of(all), ranks.rank() == 0 ? "bcc" : std::string(3, '\0'));
    std::vector<std::byte> letter(2);
    if (ranks.rank() == 0) {
      ranks.send(1, bytes_of("ab"));
      ranks.send(1, bytes_of("cd"));
    } else if (ranks.rank() == 1) {
      ranks.receive(0, letter);
      EXPECT_EQ(text_of(letter), "ab");
      ranks.receive(0, letter);
      EXPECT_EQ(text_of(letter), "cd");
    }
  });
}

TEST(ThreadRanks, AnErrorOfOneReachesAllThatAgree) {
  int thrown = 0;
  std::mutex mutex;
  as_ranks(3, [&](Ranks& ranks) {
    try {
      agree(ranks, [&] {
        if (ranks.rank() == 1) throw Error(ErrorKind::data, "test.error.made", "no room", "make some");
      });
    } catch (const Error& error) {
      const std::lock_guard lock(mutex);
      thrown += error.kind() == ErrorKind::data && error.message() == "no room" && error.remedy() == "make some";
    }
  });
  EXPECT_EQ(thrown, 3);
}

TEST(ThreadRanks, NobodyWaitsForARankThatHasEnded) {
  try {
    as_ranks(3, [](Ranks& ranks) {
      if (ranks.rank() == 1) throw Error(ErrorKind::failure, "test.error.made", "the first error", "");
      (void)all_of(ranks, 1);
    });
    FAIL() << "the others went on";
  } catch (const RankLost&) {
    FAIL() << "the error itself is what counts";
  } catch (const Error& error) {
    EXPECT_EQ(error.message(), "the first error");
  }
  EXPECT_THROW(as_ranks(2,
                        [](Ranks& ranks) {
                          if (ranks.rank() == 1) (void)all_of(ranks, 1);
                        }),
               RankLost);
}

TEST(ThreadRanks, WhoWatchesSeesThatARankHasEnded) {
  as_ranks(2, [](Ranks& ranks) {
    ranks.watch();
    (void)all_of(ranks, 1);
    if (ranks.rank() == 1) return;
    EXPECT_FALSE(ranks.lost());
    const auto watch = [&] {
      for (;;) ranks.watch();
    };
    EXPECT_THROW(watch(), RankLost);
    EXPECT_TRUE(ranks.lost());
  });
}

}  // namespace
}  // namespace semfield
