// How gradients of a device meet: the cut of a step into shards, the tree in which they are added, and exchanges
// between ranks that are threads with one device.
#include "cuda/ranks/gradient_sums.h"

#include <gtest/gtest.h>

#include <mutex>

#include "tests/cuda/device_fixture.h"
#include "tests/ranks/thread_ranks.h"

namespace semfield {
namespace {

using cuda::GradientSums;
using cuda::kShardLevels;
using cuda::kShards;
using cuda::RayRange;
using cuda::shard_of;
using cuda::ShardNode;
using testing::as_ranks;
using testing::DeviceLaunch;
using testing::NotedFault;

TEST(Shards, CoverTheRaysInOrderAndOnlyTheLastAreShorter) {
  for (const std::int64_t rays : {1, 5, 8, 100, 192, 4096, 4099}) {
    for (const int shards : {1, 2, 3, 8}) {
      const std::int64_t each = shard_of(rays, 0, shards).count;
      EXPECT_EQ(each, (rays + shards - 1) / shards);
      std::int64_t begin = 0;
      for (int s = 0; s < shards; ++s) {
        const RayRange range = shard_of(rays, s, shards);
        EXPECT_EQ(range.begin, begin) << rays << " rays, shard " << s;
        begin += range.count;
        EXPECT_TRUE(range.count == each || begin == rays) << rays << " rays, shard " << s;
      }
      EXPECT_EQ(begin, rays);
    }
  }
}

TEST(Shards, NodesAreTheFewestSubtreesOfARange) {
  using Nodes = std::vector<ShardNode>;
  EXPECT_EQ(cuda::nodes_of(0, 8), (Nodes{{0, 3}}));
  EXPECT_EQ(cuda::nodes_of(4, 8), (Nodes{{4, 2}}));
  EXPECT_EQ(cuda::nodes_of(2, 5), (Nodes{{2, 1}, {4, 0}}));
  EXPECT_EQ(cuda::nodes_of(5, 8), (Nodes{{5, 0}, {6, 1}}));
  EXPECT_EQ(cuda::nodes_of(1, 7), (Nodes{{1, 0}, {2, 1}, {4, 1}, {6, 0}}));
  EXPECT_EQ(cuda::nodes_of(3, 3), Nodes{});
}

// Numbers of many sizes: their sum shows in which order they were added.
std::vector<float> numbers(std::size_t count, std::uint64_t seed) {
  std::vector<float> values = testing::random_floats(static_cast<std::int64_t>(count), seed, -1, 1);
  for (std::size_t i = 0; i < count; ++i) values[i] *= static_cast<float>(std::int64_t{1} << (i * 7 + seed * 5) % 20);
  return values;
}
std::vector<float> sum(const std::vector<float>& a, const std::vector<float>& b) {
  std::vector<float> total(a.size());
  for (std::size_t i = 0; i < a.size(); ++i) total[i] = a[i] + b[i];
  return total;
}
std::vector<float> tree(std::size_t count, int first, int level) {
  if (level == 0) return numbers(count, static_cast<std::uint64_t>(first));
  return sum(tree(count, first, level - 1), tree(count, first + (1 << (level - 1)), level - 1));
}

// Gradients of a rank, with a launch of their own.
struct Place {
  Place(Ranks* ranks, bool deterministic, std::size_t count, std::vector<std::size_t> ends)
      : gradients(count, "a test"), sums(options(ranks, deterministic), {gradients.data(), count}, std::move(ends)) {
    sums.join();
    sums.agree([&] { sums.reserve(); });
  }
  static DeviceOptions options(Ranks* ranks, bool deterministic) {
    DeviceOptions with;
    with.deterministic = deterministic;
    with.ranks = ranks;
    return with;
  }
  void write(const std::vector<float>& values) {
    cuda::upload<float>(values, gradients.data());
    cuda::synchronize();
  }
  std::vector<float> read() {
    std::vector<float> values(gradients.size());
    cuda::download<float>(gradients.data(), values);
    sums.wait();
    return values;
  }

  DeviceLaunch launch;
  cuda::Buffer<float> gradients;
  GradientSums sums;
};

// What a step with shards does to them.
std::vector<float> sum_of_shards(Place& place) {
  const auto [first, last] = place.sums.own();
  place.sums.begin(false);
  for (int s = first; s < last; ++s) {
    place.write(sum(place.read(), numbers(place.gradients.size(), static_cast<std::uint64_t>(s))));
    place.sums.shard_done(s);
  }
  place.sums.meet(cuda::launch().fault);
  return place.read();
}

TEST(CudaGradientSums, AnyNumberOfRanksAddsShardsInTheSameOrder) {
  SEMFIELD_NEEDS_DEVICE();
  constexpr std::size_t kCount = 64 * 20;
  const std::vector<float> want = tree(kCount, 0, kShardLevels);
  {
    Place alone(nullptr, true, kCount, {kCount});
    EXPECT_EQ(sum_of_shards(alone), want);
  }
  for (const int size : {1, 2, 3, 4, 5, 8}) {
    as_ranks(size, [&](Ranks& ranks) {
      Place place(&ranks, true, kCount, {kCount});
      for (int step = 0; step < 2; ++step) {
        place.write(std::vector<float>(kCount));
        EXPECT_EQ(sum_of_shards(place), want) << size << " ranks, rank " << ranks.rank() << ", step " << step;
      }
    });
  }
}

TEST(CudaGradientSums, WithoutShardsRanksAreAddedInTheirOrderPassByPass) {
  SEMFIELD_NEEDS_DEVICE();
  constexpr std::size_t kCount = (std::size_t{1} << 20) + 64 * 20;  // more than the host exchanges at once
  for (const int size : {1, 2, 3}) {
    std::vector<float> want = numbers(kCount, 0);
    for (int r = 1; r < size; ++r) want = sum(want, numbers(kCount, static_cast<std::uint64_t>(r)));
    as_ranks(size, [&](Ranks& ranks) {
      Place place(&ranks, false, kCount, {64 * 5, 64 * 5, kCount});  // the second pass learns nothing
      EXPECT_EQ(place.sums.shards(), size);
      place.write(numbers(kCount, static_cast<std::uint64_t>(ranks.rank())));
      place.sums.begin(true);
      for (const std::size_t pass : {0, 1, 2}) place.sums.pass_done(pass);
      place.sums.shard_done(ranks.rank());
      place.sums.meet(cuda::launch().fault);
      EXPECT_EQ(place.read(), want) << size << " ranks, rank " << ranks.rank();
    });
  }
}

TEST(CudaGradientSums, TheFirstFaultOfAnyRankIsThatOfAll) {
  SEMFIELD_NEEDS_DEVICE();
  for (const bool deterministic : {false, true}) {
    as_ranks(3, [&](Ranks& ranks) {
      Place place(&ranks, deterministic, 64, {64});
      const auto meet = [&] {
        place.sums.begin(false);
        for (int s = place.sums.own().first; s < place.sums.own().second; ++s) place.sums.shard_done(s);
        place.sums.meet(cuda::launch().fault);
        place.sums.wait();
        return place.launch.take_fault();
      };
      EXPECT_EQ(meet(), std::nullopt);
      constexpr auto kLogits = static_cast<cuda::FaultKey>(cuda::Stage::logits) << cuda::kFaultRowBits;
      if (ranks.rank() > 0) place.launch.set_fault(kLogits | static_cast<cuda::FaultKey>(10 - ranks.rank()));
      EXPECT_EQ(meet(), (NotedFault{cuda::Stage::logits, 8}));
      EXPECT_EQ(meet(), std::nullopt);
    });
  }
}

TEST(CudaGradientSums, RanksThatShareADeviceMeetOnTheHostAndSaySoOnce) {
  SEMFIELD_NEEDS_DEVICE();
  as_ranks(2, [](Ranks& ranks) {
    Place place(&ranks, false, 64, {64});
    place.sums.join();
    EXPECT_TRUE(place.sums.waits());
    const std::vector<std::string> notes = place.sums.take_notes();
    ASSERT_EQ(notes.size(), 1u);
    EXPECT_TRUE(place.sums.take_notes().empty());
#ifdef SEMFIELD_NCCL
    EXPECT_NE(notes[0].find("rank 0 of this test and rank 1 of this test share a device"), std::string::npos)
        << notes[0];
#else
    EXPECT_NE(notes[0].find("NCCL"), std::string::npos) << notes[0];
#endif
  });
}

TEST(CudaGradientSums, ARankWithADeviceOfItsOwnUsesNccl) {
  SEMFIELD_NEEDS_DEVICE();
#ifndef SEMFIELD_NCCL
  GTEST_SKIP() << "this build has no NCCL";
#endif
  as_ranks(1, [](Ranks& ranks) {
    Place place(&ranks, false, 64, {64});
    for (const std::string& note : place.sums.take_notes()) ADD_FAILURE() << note;
    EXPECT_FALSE(place.sums.waits());
  });
}

TEST(CudaGradientSums, MoreRanksThanShardsAreRefusedOnAll) {
  SEMFIELD_NEEDS_DEVICE();
  int refused = 0;
  std::mutex mutex;
  as_ranks(kShards + 1, [&](Ranks& ranks) {
    try {
      const Place place(&ranks, true, 64, {64});
    } catch (const Error& error) {
      const std::lock_guard lock(mutex);
      EXPECT_NE(error.remedy().find("at most 8 processes"), std::string::npos) << error.what();
      ++refused;
    }
  });
  EXPECT_EQ(refused, kShards + 1);
}

// A rank that fails behind the others' backs does so before all of them the next time they agree.
TEST(CudaGradientSums, AnErrorOfOneRankIsMetByAll) {
  SEMFIELD_NEEDS_DEVICE();
  int thrown = 0;
  std::mutex mutex;
  as_ranks(3, [&](Ranks& ranks) {
    Place place(&ranks, false, 64, {64});
    const auto message = [&](const std::function<void()>& work) -> std::string {
      try {
        place.sums.agree(work);
        return "";
      } catch (const Error& error) {
        return error.message();
      }
    };
    const auto fail_on = [&](int rank, const char* text) {
      return [&ranks, rank, text] {
        if (ranks.rank() == rank) throw Error(ErrorKind::unavailable, text, "");
      };
    };
    EXPECT_EQ(message([] {}), "");
    EXPECT_EQ(message(fail_on(1, "no memory")), "no memory");
    place.sums.afterwards(fail_on(2, "a launch failed"));
    EXPECT_EQ(message([] {}), "a launch failed");
    EXPECT_EQ(message([] {}), "");
    const std::lock_guard lock(mutex);
    ++thrown;
  });
  EXPECT_EQ(thrown, 3);
}

}  // namespace
}  // namespace semfield
