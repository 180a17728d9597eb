// Steps that several ranks make together on devices against those of one. Ranks are threads of this process; where they
// share a device, gradients meet in the host's memory.

#include <cstdlib>

#include "cuda/ranks/gradient_sums.h"
#include "execution/ranks_executor.h"
#include "testkit/compare.h"
#include "tests/cuda/device_fixture.h"
#include "tests/ranks/thread_ranks.h"
#include "tests/says.h"
#include "tests/session/step_configs.h"
#include "train/trainer.h"

namespace semfield {
namespace {

using namespace testing_train;
using testing::as_ranks;
using testing::expect_near;

using Lead = std::function<void(Session&)>;

// Of this process alone.
void lead_alone(const std::string& yaml, const Lead& lead) {
  Registry registry = make_registry();
  Session session = open_text(yaml, registry);
  lead(session);
}

// As rank 0 of `size`, rank r on device r or all on one; the others follow.
void lead_ranks(int size, bool own_devices, const std::string& yaml, const Lead& lead) {
  as_ranks(size, [&](Ranks& ranks) {
    Registry registry = make_registry();
    Session session = open_text(yaml, registry);
    const WorkSettings work = session.work();
    const WorkScope scope(work);
    run_on({{Device::cuda, own_devices ? ranks.rank() : 0}, true, &ranks}, session.config, registry, session.plan,
           session.extent, *session.pipeline);
    if (ranks.rank() == 0) return lead(session);
    static_cast<RanksExecutor&>(session.pipeline->executor()).serve();
  });
}

struct Trained {
  std::vector<StepLosses> losses;
  std::uint32_t bits = 0;
};

// Twelve steps, queued a few at a time: graphs are captured in the third.
Lead train_into(Trained& result) {
  return [&result](Session& session) {
    Trainer trainer(session);
    while (trainer.step() < 12) {
      for (const StepLosses& losses : trainer.advance(std::min<std::int64_t>(5, 12 - trainer.step())))
        result.losses.push_back(losses);
    }
    trainer.collect();
    result.bits = fingerprint(session.pipeline->store());
  };
}

void expect_same_bits(const Trained& a, const Trained& b, const std::string& what) {
  ASSERT_EQ(a.losses.size(), b.losses.size()) << what;
  for (std::size_t i = 0; i < a.losses.size(); ++i) {
    EXPECT_EQ(a.losses[i].total, b.losses[i].total) << what << ", step " << i;
    EXPECT_EQ(a.losses[i].semantic, b.losses[i].semantic) << what << ", step " << i;
    EXPECT_EQ(a.losses[i].samples, b.losses[i].samples) << what << ", step " << i;
  }
  EXPECT_EQ(a.bits, b.bits) << what;
}

// The batches of some steps with what came of them; gradients are those of the first: its first moment is (1 - beta1)
// times the gradient.
struct Steps {
  std::vector<BatchBuffers> batches;
  std::vector<StepLosses> losses;
  std::vector<std::vector<float>> gradients;
};

// With batches as given, or else drawn.
Lead step_into(Steps& result) {
  return [&result](Session& session) {
    constexpr std::size_t kSteps = 5;
    Executor<float>& executor = session.pipeline->executor();
    const std::unique_ptr<RaySource> rays = session.make_ray_source();
    const bool draws = result.batches.empty();
    result.batches.resize(kSteps);
    for (std::size_t i = 0; i < kSteps; ++i) {
      const auto step = static_cast<std::int64_t>(i);
      if (draws) rays->fill(step, result.batches[i]);
      executor.queue(step, result.batches[i].view(session.pipeline->has_semantics()),
                     adam_step(session.config.adam, session.config.adam.learning_rate, step));
      const StepResults made = executor.finish();
      ASSERT_EQ(made.losses.size(), 1u);
      result.losses.push_back(made.losses[0]);
      executor.download(step + 1);  // ranks compare their tensors
      if (i > 0) continue;
      for (const Tensor<float>& t : session.pipeline->store().all()) {
        const std::size_t count = t.learned() ? static_cast<std::size_t>(t.size()) : 0;
        result.gradients.emplace_back(t.moment1.data(), t.moment1.data() + count);
      }
    }
  };
}

void expect_equal_steps(const Steps& ranks, const Steps& alone, const std::string& what) {
  constexpr double kFirst = 1e-4, kLater = 2e-2;  // Adam turns a rounding of a gradient near 0 into a whole step
  for (std::size_t i = 0; i < alone.losses.size(); ++i) {
    const StepLosses &a = ranks.losses[i], &b = alone.losses[i];
    const std::string here = what + ", step " + std::to_string(i);
    expect_near(a.color, b.color, i == 0 ? kFirst : kLater, here + " colour");
    expect_near(a.semantic, b.semantic, i == 0 ? kFirst : kLater, here + " semantic");
    expect_near(a.total, b.total, i == 0 ? kFirst : kLater, here + " total");
    EXPECT_EQ(a.labelled, b.labelled) << here;
  }
  EXPECT_EQ(ranks.losses[0].samples, alone.losses[0].samples) << what;
  EXPECT_EQ(ranks.losses[0].dense_passes, alone.losses[0].dense_passes) << what;
  for (std::size_t i = 0; i < kMostLossTerms; ++i)
    expect_near(ranks.losses[0].terms[i], alone.losses[0].terms[i], kFirst, what + " term " + std::to_string(i));
  ASSERT_EQ(ranks.gradients.size(), alone.gradients.size());
  for (std::size_t t = 0; t < alone.gradients.size(); ++t)
    EXPECT_EQ(testkit::compare(testing::host_view(ranks.gradients[t], 1), testing::host_view(alone.gradients[t], 1),
                               2e-3, 5e-10),
              "")
        << what << ", tensor " << t;
}

using CudaRanks = testing::DeviceTest;

TEST_F(CudaRanks, EachTakesItsPartOfTheRaysAndTheSumIsTheWholeBatchs) {
  const std::string on_device = "runtime: {device: cuda}\n";
  struct Row {
    const char* name;
    std::string yaml;
    std::vector<int> sizes;
  };
  const Row rows[] = {
      {"hash", hash_config(), {2, 3}},
      {"two_pass", two_pass_config(), {2}},
      {"few_labels", few_labels_config(""), {2, 4}},
      {"noise", two_pass_config("rendering: {density_noise: 1}\n"), {2}},
      {"terms_and_branch", branch_and_terms_config(kTerms), {2}},
      {"ranks_without_rays", with_rays(two_pass_config(), 5), {4}},
  };
  for (const Row& row : rows) {
    for (const int size : row.sizes) {
      Steps ranks, alone;
      lead_ranks(size, false, row.yaml + on_device, step_into(ranks));
      alone.batches = ranks.batches;
      lead_alone(row.yaml + on_device, step_into(alone));
      expect_equal_steps(ranks, alone, std::string(row.name) + ", " + std::to_string(size) + " ranks");
    }
  }
}

// A label that is no class, of the last rank's last ray alone: only that rank's kernels meet it.
TEST_F(CudaRanks, AFaultOfOneRankKeepsAllFromUpdating) {
  constexpr std::int64_t kBad = 4, kSteps = 8;
  std::uint32_t with_fault = 0, without = 0;
  const auto train = [&](bool fault, std::uint32_t& bits) {
    lead_ranks(2, false, two_pass_config("runtime: {device: cuda}\n"), [&](Session& session) {
      Executor<float>& executor = session.pipeline->executor();
      const std::unique_ptr<RaySource> rays = session.make_ray_source();
      BatchBuffers batch;
      const auto queue = [&](std::int64_t step) {
        executor.queue(step, batch.view(true), adam_step(session.config.adam, 1e-3, step));
      };
      for (std::int64_t step = 0; step < kSteps; ++step) {
        rays->fill(step, batch);
        if (fault && step == kBad) {
          executor.download(step);
          const std::uint32_t before = fingerprint(session.pipeline->store());
          const std::int16_t right = batch.label.back();
          batch.label.back() = 99;
          queue(step);
          queue(step + 1);  // on the way already when the fault is reported
          const StepResults results = executor.finish();
          EXPECT_EQ(results.failed, step);
          EXPECT_TRUE(results.losses.empty());
          executor.download(step);
          EXPECT_EQ(before, fingerprint(session.pipeline->store()));
          batch.label.back() = right;
        }
        queue(step);
        EXPECT_EQ(executor.finish().losses.size(), 1u) << step;
      }
      executor.download(kSteps);
      bits = fingerprint(session.pipeline->store());
    });
  };
  train(true, with_fault);
  train(false, without);
  EXPECT_EQ(with_fault, without);
}

// NCCL with a communicator of one: its calls are in the graphs of steps.
TEST_F(CudaRanks, OneRankThroughNcclHasTheBitsOfNone) {
#ifndef SEMFIELD_NCCL
  GTEST_SKIP() << "this build has no NCCL";
#endif
  for (const std::string& yaml :
       {two_pass_config("runtime: {device: cuda}\n"), hash_config("runtime: {device: cuda, deterministic: true}\n")}) {
    Trained alone, one;
    lead_alone(yaml, train_into(alone));
    lead_ranks(1, false, yaml, train_into(one));
    expect_same_bits(one, alone, yaml);
  }
}

// A sum of two numbers has no order: NCCL's is the host's. Without an occupancy grid: where its update needs more
// memory, the driver may wait for the other device, which in this test belongs to the same process.
TEST_F(CudaRanks, TwoDevicesHaveTheBitsOfTwoRanksOnOne) {
  if (testing::device_count() < 2) GTEST_SKIP() << "this machine has one device";
  // A table's entries are summed by atomics: two runs on one device differ in their bits from the second step on.
  const std::string hash = stratified_config("type: analytic_room", "", "steps: 20, rays: 64");
  for (const auto& [yaml, has_table] :
       {std::pair(two_pass_config("runtime: {device: cuda}\n"), false),
        std::pair(hash + "runtime: {device: cuda}\n", true),
        std::pair(two_pass_config("runtime: {device: cuda, precision: bf16}\n"), false)}) {
    Trained one_device, two_devices;
    lead_ranks(2, false, yaml, train_into(one_device));
    lead_ranks(2, true, yaml, train_into(two_devices));
    if (!has_table) {
      expect_same_bits(two_devices, one_device, yaml);
      continue;
    }
    ASSERT_EQ(two_devices.losses.size(), one_device.losses.size());
    for (std::size_t i = 0; i < one_device.losses.size(); ++i)
      expect_near(two_devices.losses[i].total, one_device.losses[i].total, i == 0 ? 0 : 1e-5, yaml + std::to_string(i));
    const StepLosses &first = two_devices.losses.at(0), &want = one_device.losses.at(0);
    EXPECT_EQ(first.semantic, want.semantic) << yaml;
    EXPECT_EQ(first.samples, want.samples) << yaml;
  }
}

// How gradients of a device meet: the cut of a step into parts, and exchanges between ranks that are threads with one
// device.

using cuda::GradientSums;
using cuda::RayRange;
using cuda::rays_of;
using testing::DeviceLaunch;
using testing::NotedFault;

TEST(RaysOfRanks, CoverTheBatchInOrderAndOnlyTheLastAreShorter) {
  for (const std::int64_t rays : {1, 5, 8, 100, 192, 4096, 4099}) {
    for (const int ranks : {1, 2, 3, 8}) {
      const std::int64_t each = rays_of(rays, 0, ranks).count;
      EXPECT_EQ(each, (rays + ranks - 1) / ranks);
      std::int64_t begin = 0;
      for (int r = 0; r < ranks; ++r) {
        const RayRange range = rays_of(rays, r, ranks);
        EXPECT_EQ(range.begin, begin) << rays << " rays, rank " << r;
        begin += range.count;
        EXPECT_TRUE(range.count == each || begin == rays) << rays << " rays, rank " << r;
      }
      EXPECT_EQ(begin, rays);
    }
  }
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
// Gradients of a rank, with a launch of their own.
struct Place {
  Place(Ranks* ranks, bool deterministic, std::size_t count, std::vector<std::size_t> ends)
      : gradients(count, "a test"), sums(options(ranks, deterministic), {gradients.data(), count}, std::move(ends)) {
    sums.join();
    sums.agree([&] { sums.reserve(); });
  }
  static DeviceOptions options(Ranks* ranks, bool deterministic) {
    return DeviceOptions{.deterministic = deterministic, .ranks = ranks};
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

using CudaGradientSums = testing::DeviceTest;

TEST_F(CudaGradientSums, RanksAreAddedInTheirOrderPassByPass) {
  constexpr std::size_t kCount = (std::size_t{1} << 20) + 64 * 20;  // more than the host exchanges at once
  for (const int size : {1, 2, 3}) {
    std::vector<float> want = numbers(kCount, 0);
    for (int r = 1; r < size; ++r) want = sum(want, numbers(kCount, static_cast<std::uint64_t>(r)));
    as_ranks(size, [&](Ranks& ranks) {
      Place place(&ranks, false, kCount, {64 * 5, 64 * 5, kCount});  // the second pass learns nothing
      place.write(numbers(kCount, static_cast<std::uint64_t>(ranks.rank())));
      place.sums.begin(true);
      for (const std::size_t pass : {0, 1, 2}) place.sums.pass_done(pass);
      place.sums.meet(cuda::launch().fault);
      EXPECT_EQ(place.read(), want) << size << " ranks, rank " << ranks.rank();
    });
  }
}

TEST_F(CudaGradientSums, TheFirstFaultOfAnyRankIsThatOfAll) {
  as_ranks(3, [&](Ranks& ranks) {
    Place place(&ranks, false, 64, {64});
    const auto meet = [&] {
      place.sums.begin(false);
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

TEST_F(CudaGradientSums, RanksThatShareADeviceMeetOnTheHostAndSaySoOnce) {
  as_ranks(2, [](Ranks& ranks) {
    Place place(&ranks, false, 64, {64});
    place.sums.join();
    EXPECT_TRUE(place.sums.waits());
    const std::vector<std::string> notes = place.sums.take_notes();
    ASSERT_EQ(notes.size(), 1u);
    EXPECT_TRUE(place.sums.take_notes().empty());
#ifdef SEMFIELD_NCCL
    EXPECT_HAS(notes[0], "rank 0 of this test and rank 1 of this test share a device");
#else
    EXPECT_HAS(notes[0], "NCCL");
#endif
  });
}

TEST_F(CudaGradientSums, ARankWithADeviceOfItsOwnUsesNccl) {
#ifndef SEMFIELD_NCCL
  GTEST_SKIP() << "this build has no NCCL";
#endif
  as_ranks(1, [](Ranks& ranks) {
    Place place(&ranks, false, 64, {64});
    for (const std::string& note : place.sums.take_notes()) ADD_FAILURE() << note;
    EXPECT_FALSE(place.sums.waits());
  });
}

// Equal bits are of one GPU.
TEST_F(CudaGradientSums, SeveralRanksThatAskForTheBitsOfOneAreRefusedOnAll) {
  as_ranks(2, [](Ranks& ranks) {
    EXPECT_ERROR(Place(&ranks, true, 64, {64}), "ranks.deterministic.several", "the bits of one GPU",
                 "runtime.deterministic: false");
  });
}

// A rank that fails behind the others' backs does so before all of them the next time they agree.
TEST_F(CudaGradientSums, AnErrorOfOneRankIsMetByAll) {
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
        if (ranks.rank() == rank) throw Error(ErrorKind::unavailable, "test.error.made", text, "");
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
