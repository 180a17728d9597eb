// The semantic part at points of space on the device, against that of the CPU.
#include "core/rng.h"
#include "execution/lane_executor.h"
#include "session/trainer.h"
#include "tests/cuda/device_fixture.h"
#include "tests/cuda/step_configs.h"

namespace semfield {
namespace {

using namespace testing_train;

// With a branch of the position alone and dropout, with one that reads the field, and without a branch.
std::vector<std::string> branched_configs() {
  return {branch_config(", dropout: 0.2, reads_feature: false"), branch_config("")};
}
std::vector<std::string> configs() {
  std::vector<std::string> all = branched_configs();
  all.push_back(hash_config());
  return all;
}

// Points of three regions along x, and steps that learn them.
struct Lessons {
  std::vector<Vec3d> places;
  std::vector<std::int16_t> logit;
  std::vector<float> rows;
  std::vector<std::int32_t> choice;
  std::vector<AdamStep> updates;
  static constexpr std::int64_t kBatch = 192;

  explicit Lessons(int steps, int count = 300) {
    const RandomAddress random{1, 0, stream_id("cuda_points_test")};
    std::uint64_t n = 0;
    const auto any = [&](double most) { return most * (2 * static_cast<double>(uniform01(random, n++)) - 1); };
    for (int i = 0; i < count; ++i) {
      places.push_back({1.3 * (i % 3 - 1) + any(0.4), any(1), any(0.8)});
      logit.push_back(static_cast<std::int16_t>(i % 3 == 2 ? 4 : i % 3));
    }
    for (int step = 0; step < steps; ++step) {
      updates.push_back(adam_step({}, 5e-3, step));
      for (std::int64_t b = 0; b < kBatch; ++b)
        choice.push_back(static_cast<std::int32_t>(uniform_below(random, 1000000 + choice.size(), count)));
    }
  }
  View<const double> positions() const { return {&places.data()->x, std::ssize(places), 3}; }
  View<float> rows_at(PointNetwork<float>& network, std::int32_t dims) {
    rows.assign(places.size() * static_cast<std::size_t>(dims), -1);
    const View<float> view(rows.data(), std::ssize(places), dims);
    network.rows(positions(), view);
    return view;
  }
  void learn(PointNetwork<float>& network, std::int32_t dims) {
    PointLessons<float> lessons;
    lessons.rows = {rows.data(), std::ssize(places), dims};
    lessons.logit = logit;
    lessons.choice = choice;
    lessons.batch = kBatch;
    lessons.updates = updates;
    lessons.weight_decay = 1e-2;
    network.learn(lessons);
  }
  std::vector<float> logits(PointNetwork<float>& network, std::int32_t dims) const {
    std::vector<float> out(5 * places.size());
    network.logits({rows.data(), std::ssize(places), dims}, {out.data(), std::ssize(places), 5});
    return out;
  }
};

double largest_difference(const std::vector<float>& a, const std::vector<float>& b) {
  double largest = 0;
  for (std::size_t i = 0; i < a.size(); ++i) largest = std::max(largest, std::abs(double{a[i]} - b[i]));
  return largest;
}

void restart_semantics(ParamStore<float>& store) {
  for (Tensor<float>* tensor : semantic_tensors(store))
    if (tensor->learned()) store.restart(*tensor);
}

TEST(CudaPoints, ReadAndLearnWhatTheCpuDoes) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  for (const std::string& config : configs()) {
    SCOPED_TRACE(config);
    const Session cuda = open_text(config + "runtime: {device: cuda}\n", registry);
    const Session cpu = open_text(config + "runtime: {device: cpu}\n", registry);
    PointNetwork<float>&on_device = cuda.pipeline->executor().points(), &on_cpu = cpu.pipeline->executor().points();
    const std::int32_t dims = cpu.pipeline->passes().back().point_dims();
    Lessons a(8), b(8);
    a.rows_at(on_device, dims), b.rows_at(on_cpu, dims);
    EXPECT_LT(largest_difference(a.rows, b.rows), 1e-4);
    EXPECT_LT(largest_difference(a.logits(on_device, dims), b.logits(on_cpu, dims)), 1e-3);
    a.learn(on_device, dims), b.learn(on_cpu, dims);
    const std::vector<float> learned = a.logits(on_device, dims), wanted = b.logits(on_cpu, dims);
    EXPECT_GT(largest_difference(wanted, std::vector<float>(wanted.size(), 0)), 0.1);
    EXPECT_LT(largest_difference(learned, wanted), 0.02);
    // The store has them too, and training goes on.
    const std::vector<Tensor<float>*> got = semantic_tensors(cuda.pipeline->store());
    const std::vector<Tensor<float>*> want = semantic_tensors(cpu.pipeline->store());
    ASSERT_EQ(got.size(), want.size());
    for (std::size_t i = 0; i < got.size(); ++i) {
      if (!got[i]->learned()) continue;
      for (std::int64_t e = 0; e < got[i]->size(); ++e) {
        ASSERT_NEAR(got[i]->value.data()[e], want[i]->value.data()[e], 0.01) << got[i]->name;
        ASSERT_EQ(got[i]->moment1.data()[e], 0) << got[i]->name;
      }
    }
  }
}

TEST(CudaPoints, TellRegionsApartAndLeaveTheRestAlone) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  for (const char* precision : {"fp32", "bf16"}) {
    for (const std::string& config : branched_configs()) {  // without one the field, which has not learned, is read
      SCOPED_TRACE(precision + ("\n" + config));
      Session session = open_text(config + "runtime: {device: cuda, precision: " + precision + "}\n", registry);
      const std::unique_ptr<RaySource> rays = session.make_ray_source();
      Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule,
                      session.config.train.steps);
      trainer.advance_many(5);
      trainer.collect();
      ParamStore<float>& store = session.pipeline->store();
      const auto others = [&] {
        std::vector<float> out;
        for (const Tensor<float>& t : store.all())
          if (!t.rule.semantic && t.learned()) out.insert(out.end(), t.value.data(), t.value.data() + t.value.size());
        return out;
      };
      const std::vector<float> before = others();
      PointNetwork<float>& network = session.pipeline->executor().points();
      const std::int32_t dims = session.pipeline->passes().back().point_dims();
      Lessons lessons(200);
      lessons.rows_at(network, dims);
      restart_semantics(store);
      lessons.learn(network, dims);
      std::size_t right = 0;
      const std::vector<float> logits = lessons.logits(network, dims);
      for (std::size_t i = 0; i < lessons.logit.size(); ++i) {
        const auto row = logits.begin() + static_cast<std::ptrdiff_t>(5 * i);
        right += std::max_element(row, row + 5) - row == lessons.logit[i] ? 1 : 0;
      }
      EXPECT_GT(right, lessons.logit.size() * 9 / 10);
      session.pipeline->executor().download(5);
      EXPECT_EQ(others(), before);
      const StepLosses next = trainer.advance_many(1).back();
      EXPECT_TRUE(std::isfinite(next.total));
    }
  }
}

TEST(CudaPoints, DeterministicLessonsHaveTheSameBits) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  for (const std::string& config : configs()) {
    std::vector<std::uint32_t> bits;
    for (int i = 0; i < 2; ++i) {
      const Session session = open_text(config + "runtime: {device: cuda, deterministic: true}\n", registry);
      PointNetwork<float>& network = session.pipeline->executor().points();
      const std::int32_t dims = session.pipeline->passes().back().point_dims();
      Lessons lessons(40);
      lessons.rows_at(network, dims);
      lessons.learn(network, dims);
      bits.push_back(fingerprint(session.pipeline->store()));
    }
    EXPECT_EQ(bits[0], bits[1]);
  }
}

// What was kept is put back, for what comes next on the device as well.
TEST(CudaPoints, AreReadAndWritten) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  const Session session = open_text(branch_config("") + "runtime: {device: cuda}\n", registry);
  PointNetwork<float>& network = session.pipeline->executor().points();
  const std::int32_t dims = session.pipeline->passes().back().point_dims();
  Lessons lessons(20);
  lessons.rows_at(network, dims);
  const std::vector<float> first = lessons.logits(network, dims);
  network.read();
  std::vector<std::vector<float>> kept;
  for (const Tensor<float>* t : semantic_tensors(session.pipeline->store()))
    kept.emplace_back(t->value.data(), t->value.data() + t->value.size());
  lessons.learn(network, dims);
  EXPECT_NE(lessons.logits(network, dims), first);
  std::size_t next = 0;
  for (const Tensor<float>* t : semantic_tensors(session.pipeline->store()))
    std::copy(kept[next].begin(), kept[next].end(), t->value.data()), ++next;
  network.write();
  EXPECT_EQ(lessons.logits(network, dims), first);
}

TEST(CudaPoints, AFaultIsExplainedByTheCpu) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  const Session session = open_text(branch_config("") + "runtime: {device: cuda}\n", registry);
  PointNetwork<float>& network = session.pipeline->executor().points();
  const std::int32_t dims = session.pipeline->passes().back().point_dims();
  Lessons lessons(3);
  lessons.rows_at(network, dims);
  std::fill(lessons.rows.begin(), lessons.rows.end(), std::numeric_limits<float>::quiet_NaN());
  EXPECT_HAS(error_of([&] { lessons.learn(network, dims); }), "logit of ray");
}

}  // namespace
}  // namespace semfield
