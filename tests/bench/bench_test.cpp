// What `semfield bench step` times and how it measures; the verb itself: bench_verb_test.py.

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

 private:
  Registry registry_;
};

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
