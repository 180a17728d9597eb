// Steps that several ranks make together on devices against those of one. Ranks are threads of this process; where they
// share a device, gradients meet in the host's memory.
#include <cstdlib>

#include "execution/ranks_executor.h"
#include "session/trainer.h"
#include "tests/cuda/device_fixture.h"
#include "tests/cuda/step_configs.h"
#include "tests/ranks/thread_ranks.h"

namespace semfield {
namespace {

using namespace testing_train;
using testing::as_ranks;

int devices() {
  int count = 0;
  return cudaGetDeviceCount(&count) == cudaSuccess ? count : 0;
}

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
    const std::unique_ptr<RaySource> rays = session.make_ray_source();
    Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule, session.config.train.steps);
    while (trainer.step() < 12) {
      for (const StepLosses& losses : trainer.advance_many(std::min<std::int64_t>(5, 12 - trainer.step())))
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
    EXPECT_EQ(a.losses[i].correct, b.losses[i].correct) << what << ", step " << i;
  }
  EXPECT_EQ(a.bits, b.bits) << what;
}

std::string with_rays(std::string yaml, int rays) {
  const std::size_t at = yaml.find("rays: ", yaml.find("train: {")), end = yaml.find_first_of(",}", at);
  return yaml.replace(at, end - at, "rays: " + std::to_string(rays));
}
std::string deterministic(const std::string& yaml, const std::string& more = "") {
  return yaml + "runtime: {device: cuda, deterministic: true" + more + "}\n";
}

struct BitsRow {
  const char* name;
  std::string yaml;
  std::vector<int> sizes;
};
constexpr const char* kApart = "ray_source: label_balanced, labelled_share: 0.3, label_rays_teach_color: false, ";

std::vector<BitsRow> bits_rows() {
  return {
      {"hash", deterministic(hash_config()), {1, 2, 3, 4}},
      {"hash_bf16", deterministic(hash_config(), ", precision: bf16"), {2}},
      {"two_pass", deterministic(two_pass_config()), {1, 2, 4}},
      {"branch", deterministic(branch_config(", dropout: 0.2")), {2}},
      {"terms", deterministic(two_pass_config(kTerms)), {2}},
      {"few_labels", deterministic(few_labels_config("")), {4}},
      // Rays that are there for their labels stand first in each rank's part, so batches differ where steps are not cut
      // into shards.
      {"label_rays_apart", deterministic(label_rays_config(kApart)), {2, 4}},
      {"shorter_last_shard", deterministic(with_rays(hash_config(), 100)), {2, 3}},
      {"shards_without_rays", deterministic(with_rays(two_pass_config(), 5)), {2, 4}},
  };
}

TEST(CudaRanks, DeterministicStepsHaveTheSameBitsForAnyNumberOfRanks) {
  SEMFIELD_NEEDS_DEVICE();
  for (const BitsRow& row : bits_rows()) {
    Trained alone;
    lead_alone(row.yaml, train_into(alone));
    for (const int size : row.sizes) {
      Trained ranks;
      lead_ranks(size, false, row.yaml, train_into(ranks));
      expect_same_bits(ranks, alone, std::string(row.name) + ", " + std::to_string(size) + " ranks");
    }
  }
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

void expect_near(double got, double want, double relative, const std::string& what) {
  EXPECT_NEAR(got, want, relative * std::max(1e-6, std::abs(want))) << what;
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
  for (std::size_t t = 0; t < alone.gradients.size(); ++t) {
    double largest = 0, off = 0;
    for (std::size_t e = 0; e < alone.gradients[t].size(); ++e) {
      const double want = alone.gradients[t][e], got = ranks.gradients[t][e];
      largest = std::max(largest, std::abs(want));
      off = std::max(off, std::abs(got - want));
    }
    EXPECT_LE(off, 2e-3 * largest + 1e-12) << what << ", tensor " << t << ", largest " << largest;
  }
}

TEST(CudaRanks, EachTakesItsPartOfTheRaysAndTheSumIsTheWholeBatchs) {
  SEMFIELD_NEEDS_DEVICE();
  const std::string on_device = "runtime: {device: cuda}\n";
  const std::vector<BitsRow> rows{
      {"hash", hash_config(), {2, 3}},
      {"two_pass", two_pass_config(), {2}},
      {"few_labels", few_labels_config(""), {2, 4}},
      {"noise", two_pass_config("rendering: {density_noise: 1}\n"), {2}},
      {"terms_and_branch", branch_and_terms_config(kTerms), {2}},
      {"ranks_without_rays", with_rays(two_pass_config(), 5), {4}},
  };
  for (const BitsRow& row : rows) {
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
TEST(CudaRanks, AFaultOfOneRankKeepsAllFromUpdating) {
  SEMFIELD_NEEDS_DEVICE();
  constexpr std::int64_t kBad = 4, kSteps = 8;
  for (const std::string runtime : {"runtime: {device: cuda}\n", "runtime: {device: cuda, deterministic: true}\n"}) {
    std::uint32_t with_fault = 0, without = 0;
    const auto train = [&](bool fault, std::uint32_t& bits) {
      lead_ranks(2, false, two_pass_config(runtime), [&](Session& session) {
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
    EXPECT_EQ(with_fault, without) << runtime;
  }
}

// NCCL with a communicator of one: its calls are in the graphs of steps.
TEST(CudaRanks, OneRankThroughNcclHasTheBitsOfNone) {
  SEMFIELD_NEEDS_DEVICE();
#ifndef SEMFIELD_NCCL
  GTEST_SKIP() << "this build has no NCCL";
#endif
  for (const std::string& yaml : {two_pass_config("runtime: {device: cuda}\n"), deterministic(hash_config())}) {
    Trained alone, one;
    lead_alone(yaml, train_into(alone));
    lead_ranks(1, false, yaml, train_into(one));
    expect_same_bits(one, alone, yaml);
  }
}

// A sum of two numbers has no order: NCCL's is the host's. Without an occupancy grid: where its update needs more
// memory, the driver may wait for the other device, which in this test belongs to the same process.
TEST(CudaRanks, TwoDevicesHaveTheBitsOfTwoRanksOnOne) {
  SEMFIELD_NEEDS_DEVICE();
  if (devices() < 2) GTEST_SKIP() << "this machine has one device";
  const std::string hash = stratified_config("type: analytic_room", "", "steps: 20, rays: 64");
  for (const std::string& yaml : {two_pass_config("runtime: {device: cuda}\n"), deterministic(hash),
                                  deterministic(two_pass_config(), ", precision: bf16")}) {
    Trained one_device, two_devices;
    lead_ranks(2, false, yaml, train_into(one_device));
    lead_ranks(2, true, yaml, train_into(two_devices));
    expect_same_bits(two_devices, one_device, yaml);
  }
}

}  // namespace
}  // namespace semfield
