// What `semfield bench step` counts and how it measures; the verb itself: bench_verb_test.py.

#include <gtest/gtest.h>

#include <atomic>
#include <cstdlib>
#include <new>

#include "app/bench/step_case.h"
#include "plugin/loader.h"

namespace {
std::atomic<std::int64_t> taken_bytes{0};

void* counted(void* memory, std::size_t bytes) {
  taken_bytes += static_cast<std::int64_t>(bytes);
  if (memory == nullptr) throw std::bad_alloc();
  return memory;
}
}  // namespace

// What this program and its libraries take; array forms call these. Not inlined: a compiler that sees malloc in one
// half of a pair warns of the other.
[[gnu::noinline]] void* operator new(std::size_t bytes) { return counted(std::malloc(bytes > 0 ? bytes : 1), bytes); }
[[gnu::noinline]] void* operator new(std::size_t bytes, std::align_val_t alignment) {
  const auto step = static_cast<std::size_t>(alignment);
  return counted(std::aligned_alloc(step, (bytes + step) / step * step), bytes);
}
// A sanitizer's own would not call the one above.
void* operator new(std::size_t bytes, const std::nothrow_t&) noexcept { return std::malloc(bytes > 0 ? bytes : 1); }
[[gnu::noinline]] void operator delete(void* memory) noexcept { std::free(memory); }
[[gnu::noinline]] void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }
[[gnu::noinline]] void operator delete(void* memory, std::align_val_t) noexcept { std::free(memory); }
[[gnu::noinline]] void operator delete(void* memory, std::size_t, std::align_val_t) noexcept { std::free(memory); }

namespace semfield {
namespace {

// Counting the work of a step against sums done by hand, and the step on made-up rays.

double layer_flop(const std::vector<LayerWork>& layers, const std::string& name) {
  for (const LayerWork& layer : layers) {
    if (layer.layer == name) return layer.flop();
  }
  ADD_FAILURE() << "no layer " << name;
  return 0;
}

class StepCases : public testing::Test {
 public:
  StepCases() { register_linked_plugins(registry_); }
  StepCase make(const std::string& config, int classes, std::vector<std::string> set = {}) {
    StepCaseOptions options{.config = std::string(SEMFIELD_SOURCE_DIR "/configs/") + config,
                            .set = std::move(set),
                            .classes = classes,
                            .rays = 16};
    return StepCase(options, registry_);
  }
  /// Without the exact savings.
  static std::vector<std::string> as_written() {
    return {"runtime.fold_feature_layer=false", "runtime.direction_once_per_ray=false",
            "runtime.deferred_class_layer=false"};
  }

 private:
  Registry registry_;
};

// 1,024 rays with 64 and 192 samples.
double paper_flop(StepCases& cases, int classes, std::vector<std::string> set = {}) {
  return total_flop(cases.make("paper.yaml", classes, std::move(set)).work()) * 1024 / 16;
}

// Of the 16 rays of a case: once per step is counted 64 times by paper_flop.
TEST_F(StepCases, PaperStepIsWhatOneCountsByHand) {
  // Multiply-adds of a sample, forward: x into layers 0 and 5, seven 256 x 256 layers, density, folded view layer,
  // colour, semantic hidden layer.
  const double x = 2 * 63 * 256;
  const double rest = 7 * 256 * 256 + 256 + 256 * 128 + 128 * 3 + 256 * 128;
  EXPECT_EQ(x + rest, 557184);
  // Twice for two operations, times three for both gradients; positions take none.
  const double samples = 1024 * (64 + 192);
  double flop = 2 * samples * (2 * x + 3 * rest);
  // Two networks: class layer and direction term once per ray, and the product of the folded weights and bias once a
  // step.
  const double folded = 2 * 2 * 3 * (257.0 * 256 * 128);
  flop += 2 * 2 * 1024 * (3.0 * 128 * 29 + 2.0 * 27 * 128) + 64 * folded;
  EXPECT_EQ(paper_flop(*this, 29), flop);
  EXPECT_NEAR((flop - 63 * folded) * 1e-12, 0.860, 5e-4);
}

TEST_F(StepCases, AsWrittenStepIsWhatOneCountsByHand) {
  const double samples = 1024 * (64 + 192);
  const double no_gradient = 2 * 63 * 256 + 27 * 128;
  const double rest = 7 * 256 * 256 + 256 + 256 * 256 + 256 * 128 + 128 * 3 + 256 * 128 + 128 * 29;
  const double flop = paper_flop(*this, 29, as_written());
  EXPECT_EQ(flop, 2 * samples * (2 * no_gradient + 3 * rest));
  EXPECT_NEAR(flop * 1e-12, 0.972, 5e-4);
}

TEST_F(StepCases, ClassesCostARayNotASample) {
  const double few = paper_flop(*this, 13), more = paper_flop(*this, 512) - few;
  EXPECT_EQ(more, 2 * 2.0 * 1024 * 3 * 128 * (512 - 13));
  EXPECT_LT(more / few, 0.001);
  EXPECT_LT(paper_flop(*this, 0), paper_flop(*this, 1) * 0.95);  // the hidden layer goes as well
}

TEST_F(StepCases, SmallNetworkIsWhatOneCountsByHand) {
  const std::vector<LayerWork> layers = make("bench/hash_step.yaml", 5).work();
  const double rays = 16, samples = 16 * 30;
  const double a_sample = 32 * 64 + 64 * 16 + 15 * 64 + 64 * 64 + 64 * 3 + 64 * 64;
  EXPECT_EQ(total_flop(layers), 2 * 3 * samples * a_sample + 2 * 2 * rays * (16 * 64) + 2 * 3 * rays * (64 * 5));
  EXPECT_EQ(layer_flop(layers, "rgb"), 2 * 3 * samples * 64 * 3);
}

TEST_F(StepCases, AStepTrainsOnEveryRaysSamples) {
  StepCase step = make("bench/hash_step.yaml", 5, {"passes.0.position.log2_entries=10"});
  EXPECT_EQ(step.samples_per_step(), 16 * 30);
  step.seconds(1, 1);
  const double first = step.loss();
  EXPECT_GT(first, 0.04 * 0.5 * std::log(5.0));  // colours of noise and labels of chance
  EXPECT_GT(step.seconds(2, 3), 0);
  EXPECT_NE(step.loss(), first);
}

TEST_F(StepCases, StepsAllocateNothingAfterTheFirst) {
  const std::vector<std::string> narrow = {"passes.0.sampler.samples=8", "passes.1.sampler.samples=8",
                                           "semantics.hidden_width=16", "passes.0.field.width=32",
                                           "passes.0.field.view_width=16"};
  for (const std::string precision : {"fp32", "bf16"}) {
    for (const int classes : {0, 29, 512}) {
      std::vector<std::string> set = narrow;
      set.push_back("runtime.precision=" + precision);
      StepCase paper = make("paper.yaml", classes, set);
      StepCase hash = make("bench/hash_step.yaml", classes, {set.back(), "passes.0.position.log2_entries=15"});
      for (StepCase* const step : {&paper, &hash}) {
        for (const int threads : {1, 2}) {
          StepCase::start_threads(threads);
          step->seconds(threads, 1);
          const std::int64_t before = taken_bytes;
          step->seconds(threads, 3);
          EXPECT_EQ(taken_bytes, before) << precision << ", " << classes << " classes, " << threads << " threads";
        }
      }
    }
  }
}

TEST(Spreads, MedianAndEnds) {
  const Spread odd = spread_of({3, 1, 2});
  EXPECT_EQ(odd.median, 2);
  EXPECT_EQ(odd.min, 1);
  EXPECT_EQ(odd.max, 3);
  EXPECT_EQ(spread_of({4, 1, 2, 3}).median, 2.5);
}

TEST(Spreads, MeasurementsAlternate) {
  std::string order;
  alternate({[&] { return order += 'a', 0.0; }, [&] { return order += 'b', 0.0; }}, 3);
  EXPECT_EQ(order, "ababab");
}

}  // namespace
}  // namespace semfield
