// `semfield bench step` on narrow networks: its words, its last line, and that steps allocate nothing.
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <fstream>
#include <nlohmann/json.hpp>
#include <regex>

#include "app/bench/step_case.h"
#include "compute/peak_probe.h"
#include "core/text.h"
#include "plugin/loader.h"
#include "tests/says.h"

namespace semfield {
namespace {

using nlohmann::json;

struct Result {
  int code = -1;
  std::string out;
};

Result run(const std::string& words) {
  Result result;
  FILE* const pipe = popen((shell_word(SEMFIELD_PROGRAM) + " -q " + words + " 2>&1").c_str(), "r");
  std::array<char, 4096> buffer{};
  while (fgets(buffer.data(), static_cast<int>(buffer.size()), pipe) != nullptr) result.out += buffer.data();
  result.code = WEXITSTATUS(pclose(pipe));
  return result;
}

const char* const kTiny = "bench step --size tiny --repeats 1 ";

std::string last_line(const std::string& text) {
  const std::size_t end = text.find_last_not_of('\n');
  const std::size_t begin = text.rfind('\n', end);
  return text.substr(begin + 1, end - begin);
}

TEST(BenchVerb, LastLineHasEveryGoal) {
  const Result r = run(kTiny);
  ASSERT_EQ(r.code, 0) << r.out;
  const std::string number = R"(([0-9]+\.[0-9]{1,2}))";
  EXPECT_TRUE(std::regex_match(last_line(r.out), std::regex("bench: P1=n/a P2=n/a P2c=(" + number + "|n/a) P3=n/a P4=" +
                                                            number + " P7=" + number + " P8=" + number + " threads2=(" +
                                                            number + "|n/a) P15=(" + number + "|n/a) isa=[a-z0-9_]+")))
      << last_line(r.out);
}

TEST(BenchVerb, StepsAllocateNothingAfterTheFirst) {
  const Result r = run(std::string("--json ") + kTiny);
  ASSERT_EQ(r.code, 0) << r.out;
  const json out = json::parse(r.out);
  int rows = 0;
  for (const char* group : {"steps", "classes", "scaling"}) {
    for (const json& row : out[group]) {
      ++rows;
      EXPECT_EQ(row["allocated_bytes"], 0) << row.dump();
      EXPECT_GT(row["seconds"]["median"], 0) << row.dump();
      EXPECT_GT(row["flop"], 0) << row.dump();
    }
  }
  EXPECT_GE(rows, 13);  // three networks, five numbers of classes for two of them
  EXPECT_GT(out["peak_fp32_flops"][0], 0);
  EXPECT_NEAR(out["goals"]["P4"].get<double>(), out["steps"][0]["peak_share"].get<double>(), 1e-12);
}

TEST(BenchVerb, WithoutAPeerItSaysWhy) {
  const Result r = run(std::string(kTiny) + "--peers --python /no/such/python");
  EXPECT_EQ(r.code, 0) << r.out;
  EXPECT_HAS(r.out, "no Python with torch (asked: /no/such/python)");
  EXPECT_HAS(last_line(r.out), "P1=n/a P2=n/a P2c=") << r.out;
}

// An interpreter that responds as the peer's script does, always with the same time.
TEST(BenchVerb, RatiosAreOfRatesBesideThePeer) {
  const std::string fake = testing::TempDir() + "fake_python_" + std::to_string(::getpid());
  std::ofstream(fake) << "#!/bin/sh\n[ \"$1\" = -c ] && exit 0\n"
                         "echo '{\"torch\": \"0\", \"threads\": 2, \"blas\": \"openblas\"}'\n"
                         "while read -r line; do\n"
                         "  case $line in *hash*) echo '{\"seconds\": 2.0}';; *) echo '{\"seconds\": 3.0}';; esac\n"
                         "done\n";
  chmod(fake.c_str(), 0755);
  const Result r = run(std::string("--json ") + kTiny + "--peers --python " + shell_word(fake));
  ASSERT_EQ(r.code, 0) << r.out;
  const json out = json::parse(r.out);
  ASSERT_GE(out["peers"].size(), 4u) << r.out;
  double hash_rate = 0, paper_rate = 0;
  for (const json& row : out["steps"]) {
    if (row["net"] == "hash T=2^15" && row["precision"] == "fp32") hash_rate = row["samples_per_s"];
    if (row["net"] == "paper" && row["precision"] == "fp32") paper_rate = row["samples_per_s"];
  }
  const double rays = out["steps"][0]["rays"];
  EXPECT_NEAR(out["goals"]["P1"].get<double>(), paper_rate / (rays * 256 / 3.0), 1e-6);
  EXPECT_NEAR(out["goals"]["P3"].get<double>(), hash_rate / (rays * 30 / 2.0), 1e-6);
}

TEST(BenchVerb, WrongWordsAreRefused) {
  EXPECT_EQ(run("bench step --size huge").code, 2);
  EXPECT_EQ(run("bench step --repeats 0").code, 2);
  EXPECT_EQ(run(std::string(kTiny) + "--set runtime.thread=1").code, 78);
  EXPECT_EQ(run("bench").code, 2);
  EXPECT_HAS(run("bench pairs").out, "studies/leave_out.py");
}

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

// What a loop leaves behind shows how many rounds each of its chains made; a count that is none of theirs shows. The
// time beside it is the machine's.
TEST(PeakProbe, CountsTheOperationsThatItsLoopsExecute) {
  const double chains = kProbeChains, rounds = kProbeRounds;
  std::vector<std::string> names;
  for (const ProbeCall& call : probe_calls()) {
    const std::string name = names.emplace_back(call.name);
    if (name == "fp32") {
      const double lanes = call.operations / (2 * chains * rounds);
      double sum = 0;
      for (int i = 0; i < kProbeChains; ++i) sum += lanes * (1 + i * std::pow(kProbeScale, rounds));
      EXPECT_NEAR(call.result, sum, 0.01 * sum) << lanes << " floats in a vector";
    } else if (name == "bf16") {
      const double pairs = call.operations / (2 * 2 * chains * rounds);
      double sum = 0;
      for (int i = 0; i < kProbeChains; ++i) sum += pairs * (1 + i + 0.5 * rounds * (0.004 + 0.000006));
      EXPECT_NEAR(call.result, sum, 0.02 * sum) << pairs << " pairs in a vector";
    } else {
      EXPECT_EQ(name, "tiles");
      EXPECT_EQ(call.result, 0.25 * call.operations) << "an operation is a product or a sum, and half are with 0";
    }
  }
  EXPECT_EQ(names.front(), "fp32");
}

TEST(PeakProbe, EveryThreadMakesACallAndRatesAreOfTheTimeThatPassed) {
  const auto begin = std::chrono::steady_clock::now();
  const double rate = peak_fp32_flops(2, 0.02);
  const double wall_s = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  const double a_call = probe_calls().front().operations;
  EXPECT_GE(rate * wall_s, 2 * a_call) << "operations of at least a call of each thread";
}

}  // namespace
}  // namespace semfield
