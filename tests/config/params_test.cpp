// Parameters read from the tree: every mistake refused, with its exact sentence; written back exactly; described.
#include "config/params.h"

#include <array>
#include <cmath>
#include <cstring>
#include <regex>

#include "config_testing.h"

namespace semfield {

enum class Interp { linear, smoothstep };
template <>
struct ChoiceNames<Interp> {
  static constexpr std::array<std::string_view, 2> names{"linear", "smoothstep"};
};

namespace {

struct Sample {
  int levels = 16;
  std::int64_t seed = 1;
  std::uint8_t small = 3;
  double growth = 1.5;
  float rate = 0.25f;
  bool dense = false;
  std::string root = "data/room";
  Interp interpolation = Interp::linear;
  std::vector<std::int64_t> skips{4};
  std::vector<double> betas{0.9, 0.999};
  std::vector<std::string> files;
};

void describe(ParamVisitor& visit, Sample& p) {
  SEMFIELD_PARAM(visit, p, levels, "L, number of resolutions", {1, 32});
  SEMFIELD_PARAM(visit, p, seed, "Seed of all randomness", {0});
  SEMFIELD_PARAM(visit, p, small, "A byte");
  SEMFIELD_PARAM(visit, p, growth, "b, growth of the resolution", {1, 2.5});
  SEMFIELD_PARAM(visit, p, rate, "Learning rate");
  SEMFIELD_PARAM(visit, p, dense, "Dense or hashed");
  SEMFIELD_PARAM(visit, p, root, "Folder");
  SEMFIELD_PARAM(visit, p, interpolation, "Weights between corners");
  SEMFIELD_PARAM(visit, p, skips, "Layers that see the input again", {0, 8});
  SEMFIELD_PARAM(visit, p, betas, "Decay of the moments", {0, 1});
  SEMFIELD_PARAM(visit, p, files, "Plugin files");
}

Describe describer(Sample& p) {
  return [&p](ParamVisitor& visit) { describe(visit, p); };
}

/// All errors of reading `yaml` (a map) at path "encoder", one per line.
std::string errors_of(const std::string& yaml, Sample* out = nullptr) {
  Sample sample;
  Diagnostics diagnostics;
  read_params(parse_config_text(yaml, "room.yaml"), "encoder", describer(sample), diagnostics, {"type"});
  if (out != nullptr) *out = sample;
  std::string text;
  for (const Diagnostic& finding : diagnostics.all()) text += (text.empty() ? "" : "\n") + finding.text();
  return text;
}

TEST(ParamsRead, TakesEveryType) {
  Sample p;
  EXPECT_EQ(errors_of("type: x\nlevels: 8\nseed: 9223372036854775807\nsmall: 255\ngrowth: 2\nrate: 1e-3\ndense: true\n"
                      "root: 10%\ninterpolation: smoothstep\nskips: [0, +8]\nbetas: [.5, 1.]\nfiles: [a, 'b c', 3]\n",
                      &p),
            "");
  EXPECT_EQ(p.levels, 8);
  EXPECT_EQ(p.seed, std::numeric_limits<std::int64_t>::max());
  EXPECT_EQ(p.small, 255);
  EXPECT_EQ(p.growth, 2.0);
  EXPECT_EQ(p.rate, 1e-3f);
  EXPECT_TRUE(p.dense);
  EXPECT_EQ(p.root, "10%");
  EXPECT_EQ(p.interpolation, Interp::smoothstep);
  EXPECT_EQ(p.skips, (std::vector<std::int64_t>{0, 8}));
  EXPECT_EQ(p.betas, (std::vector<double>{0.5, 1.0}));
  EXPECT_EQ(p.files, (std::vector<std::string>{"a", "b c", "3"}));
}

TEST(ParamsRead, MissingKeysKeepDefaults) {
  Sample p;
  EXPECT_EQ(errors_of("", &p), "");
  EXPECT_EQ(p.levels, 16);
  EXPECT_EQ(p.betas.size(), 2u);
  Diagnostics diagnostics;
  const ConfigNode parent = parse_config_text("train:\n", "room.yaml");  // every line of the section commented out
  read_params(*parent.find("train"), "train", describer(p), diagnostics);
  EXPECT_FALSE(diagnostics.has_errors());
}

TEST(ParamsRead, IntegersAreStrict) {
  EXPECT_EQ(errors_of("levels: big"), "room.yaml:1:9: encoder.levels: expected int, got 'big'");
  EXPECT_EQ(errors_of("levels: 010"),
            "room.yaml:1:9: encoder.levels: expected int, got '010'; write it without leading zeros");
  EXPECT_EQ(errors_of("levels: 8.0"), "room.yaml:1:9: encoder.levels: expected int, got '8.0'");
  EXPECT_EQ(errors_of("levels: 1e1"), "room.yaml:1:9: encoder.levels: expected int, got '1e1'");
  EXPECT_EQ(errors_of("levels: 0x10"), "room.yaml:1:9: encoder.levels: expected int, got '0x10'");
  EXPECT_EQ(errors_of("levels: 1_000"), "room.yaml:1:9: encoder.levels: expected int, got '1_000'");
  EXPECT_EQ(errors_of("levels: true"), "room.yaml:1:9: encoder.levels: expected int, got 'true'");
  EXPECT_EQ(errors_of("levels: '8'"),
            "room.yaml:1:9: encoder.levels: expected int, got text '8'; numbers stand without quotes");
  EXPECT_EQ(errors_of("levels: ~"), "room.yaml:1:9: encoder.levels: expected int, got nothing");
  EXPECT_EQ(errors_of("levels:"), "room.yaml:1:8: encoder.levels: expected int, got nothing");
  EXPECT_EQ(errors_of("levels: [8]"), "room.yaml:1:9: encoder.levels: expected int, got a list");
  EXPECT_EQ(errors_of("levels: {a: 8}"), "room.yaml:1:9: encoder.levels: expected int, got a map");
  EXPECT_EQ(errors_of("seed: 9223372036854775808"),
            "room.yaml:1:7: encoder.seed: expected int, got '9223372036854775808'; it does not fit 64 bits");
  EXPECT_EQ(errors_of("levels: +"), "room.yaml:1:9: encoder.levels: expected int, got '+'");
  EXPECT_EQ(errors_of("levels: +-8"), "room.yaml:1:9: encoder.levels: expected int, got '+-8'");
}

TEST(ParamsRead, RangesAreNamed) {
  EXPECT_EQ(errors_of("levels: 99"), "room.yaml:1:9: encoder.levels: expected int in [1, 32], got 99");
  EXPECT_EQ(errors_of("levels: 0"), "room.yaml:1:9: encoder.levels: expected int in [1, 32], got 0");
  EXPECT_EQ(errors_of("seed: -1"), "room.yaml:1:7: encoder.seed: expected int >= 0, got -1");
  EXPECT_EQ(errors_of("small: 256"), "room.yaml:1:8: encoder.small: expected int in [0, 255], got 256");
  EXPECT_EQ(errors_of("growth: 3"), "room.yaml:1:9: encoder.growth: expected number in [1, 2.5], got 3");
  EXPECT_EQ(
      errors_of("rate: 1e39"),
      "room.yaml:1:7: encoder.rate: expected number in [-3.4028234663852886e+38, 3.4028234663852886e+38], got 1e39");
  EXPECT_EQ(errors_of("skips: [1, 9]"), "room.yaml:1:12: encoder.skips.1: expected int in [0, 8], got 9");
}

TEST(ParamsRead, NumbersAreStrict) {
  for (const std::string word : {".nan", ".NaN", ".inf", "-.inf", "nan", "inf"})
    EXPECT_EQ(errors_of("rate: " + word),
              "room.yaml:1:7: encoder.rate: expected number, got '" + word + "'; only finite numbers are allowed");
  for (const std::string word : {"1e400", "-1e400", "1e-400"})
    EXPECT_EQ(errors_of("rate: " + word),
              "room.yaml:1:7: encoder.rate: expected number, got '" + word + "'; it is beyond the range of a double");
  for (const std::string word : {"010", "00.5", "-01"})
    EXPECT_EQ(errors_of("rate: " + word),
              "room.yaml:1:7: encoder.rate: expected number, got '" + word + "'; write it without leading zeros");
  for (const std::string word :
       {"big", "1e", "1e+", ".", "-x", "1.2.3", "1,5", "0x1p3", "1f", "1 2", "e5", "infinity"}) {
    EXPECT_EQ(errors_of("rate: " + word), "room.yaml:1:7: encoder.rate: expected number, got '" + word + "'");
  }
  Sample p;
  EXPECT_EQ(errors_of("growth: 1.5e0\nrate: -0.5", &p), "");
  EXPECT_EQ(p.growth, 1.5);
  EXPECT_EQ(p.rate, -0.5f);
}

TEST(ParamsRead, BoolsAreTrueOrFalse) {
  for (const std::string word : {"no", "yes", "on", "True", "FALSE", "1", "y"})
    EXPECT_EQ(errors_of("dense: " + word),
              "room.yaml:1:8: encoder.dense: expected bool, got '" + word + "'; write true or false");
  EXPECT_EQ(errors_of("dense: 'true'"),
            "room.yaml:1:8: encoder.dense: expected bool, got text 'true'; write true or false");
}

TEST(ParamsRead, ChoicesListsTexts) {
  EXPECT_EQ(errors_of("interpolation: smothstep"),
            "room.yaml:1:16: encoder.interpolation: expected one of linear, smoothstep, got 'smothstep'; "
            "did you mean 'smoothstep'?");
  EXPECT_EQ(errors_of("interpolation: 1"),
            "room.yaml:1:16: encoder.interpolation: expected one of linear, smoothstep, got '1'");
  EXPECT_EQ(errors_of("skips: 5"), "room.yaml:1:8: encoder.skips: expected list of int, got '5'; write [5]");
  EXPECT_EQ(errors_of("betas: {a: 1}"), "room.yaml:1:8: encoder.betas: expected list of number, got a map");
  EXPECT_EQ(errors_of("files: [[a]]"), "room.yaml:1:9: encoder.files.0: expected text, got a list");
  EXPECT_EQ(errors_of("root: ~"), "room.yaml:1:7: encoder.root: expected text, got nothing");
  Sample p;
  EXPECT_EQ(errors_of("betas: [0.5, x, 0.7, y]", &p),
            "room.yaml:1:14: encoder.betas.1: expected number, got 'x'\nroom.yaml:1:22: encoder.betas.3: expected "
            "number, got 'y'");
  EXPECT_EQ(p.betas, (std::vector<double>{0.9, 0.999}));  // not half a list
}

TEST(ParamsRead, UnknownKeysAndAllErrorsAtOnce) {
  EXPECT_EQ(
      errors_of("encoder_levels_of_all: 1"),
      "room.yaml:1:1: encoder: unknown key 'encoder_levels_of_all'; known: levels, seed, small, growth, rate, dense, "
      "root, interpolation, skips, betas, files, type");
  EXPECT_EQ(errors_of("n_level: 8\nlevels: big\ndense: no\n"),
            "room.yaml:2:9: encoder.levels: expected int, got 'big'\n"
            "room.yaml:3:8: encoder.dense: expected bool, got 'no'; write true or false\n"
            "room.yaml:1:1: encoder: unknown key 'n_level'; did you mean 'levels'?");
  Diagnostics diagnostics;
  Sample p;
  read_params(
      parse_config_text("x: 1", "room.yaml"), "", [](ParamVisitor&) {}, diagnostics);
  read_params(parse_config_text("[1]", "room.yaml"), "train", describer(p), diagnostics);
  read_params(parse_config_text("levels: x", "room.yaml"), "", describer(p), diagnostics);
  ASSERT_EQ(diagnostics.error_count(), 3);
  EXPECT_EQ(diagnostics.all()[0].text(), "room.yaml:1:1: unknown key 'x'; there are no keys here");
  EXPECT_EQ(diagnostics.all()[1].text(), "room.yaml:1:1: train: expected a map, got a list");
  EXPECT_EQ(diagnostics.all()[2].text(), "room.yaml:1:9: levels: expected int, got 'x'");
}

TEST(ParamsRead, ReadTextOfFreeKeys) {
  Diagnostics diagnostics;
  const ConfigNode root = parse_config_text("name: coarse\nbad: [1]\n", "room.yaml");
  EXPECT_EQ(read_text(root, "passes.0", "name", "x", diagnostics), "coarse");
  EXPECT_EQ(read_text(root, "passes.0", "none", "x", diagnostics), "x");
  EXPECT_FALSE(diagnostics.has_errors());
  EXPECT_EQ(read_text(root, "passes.0", "bad", "x", diagnostics), "x");
  EXPECT_EQ(diagnostics.all()[0].text(), "room.yaml:2:6: passes.0.bad: expected text, got a list");
}

TEST(ParamsWrite, ResolvedTreeReadsBackTheSame) {
  Sample p;
  p.growth = 0.1 + 0.2 + 1.0;
  p.rate = 1e-5f;
  p.seed = std::numeric_limits<std::int64_t>::max();
  p.root = "010";
  p.interpolation = Interp::smoothstep;
  p.betas = {5e-324, 0.1, 1.0};
  p.files = {"true", "a: b", "größe", ""};
  const std::string yaml = write_config(params_to_config(describer(p)));
  Sample q;
  EXPECT_EQ(errors_of(yaml, &q), "") << yaml;
  EXPECT_HAS(yaml, "root: \"010\"\n");  // other YAML readers must see a text, too
  EXPECT_HAS(yaml, "files: [\"true\", \"a: b\", ");
  EXPECT_EQ(write_config(params_to_config(describer(q))), yaml);
  EXPECT_EQ(q.growth, p.growth);
  EXPECT_EQ(q.rate, p.rate);
  EXPECT_EQ(q.seed, p.seed);
  EXPECT_EQ(q.betas, p.betas);
  EXPECT_EQ(q.files, p.files);
  EXPECT_EQ(q.root, p.root);
  EXPECT_EQ(
      write_config(params_to_config(describer(*std::make_unique<Sample>()))),
      "levels: 16\nseed: 1\nsmall: 3\ngrowth: 1.5\nrate: 0.25\ndense: false\nroot: data/room\ninterpolation: linear\n"
      "skips: [4]\nbetas: [0.9, 0.999]\nfiles: []\n");
}

TEST(ParamsWrite, DoublesAreShortestAndExact) {
  EXPECT_EQ(shortest_number(0.1), "0.1");
  EXPECT_EQ(shortest_number(64), "64.0");
  EXPECT_EQ(shortest_number(1e-5), "1.0e-05");
  EXPECT_EQ(shortest_number(-2e300), "-2.0e+300");
  EXPECT_EQ(shortest_number(-0.0), "-0.0");
  std::uint64_t state = 88172645463325252ull;
  for (int i = 0; i < 2000; ++i) {  // bit patterns from xorshift: all magnitudes
    state ^= state << 13, state ^= state >> 7, state ^= state << 17;
    double value = 0;
    static_assert(sizeof value == sizeof state);
    std::memcpy(&value, &state, sizeof value);
    if (!std::isfinite(value)) continue;
    // What YAML 1.1, which most readers speak, takes for a number and not for a text.
    static const std::regex number_of_yaml_1_1("[-+]?[0-9]+\\.[0-9]*([eE][-+][0-9]+)?");
    ASSERT_TRUE(std::regex_match(shortest_number(value), number_of_yaml_1_1)) << shortest_number(value);
    struct One {
      double x = 0;
    } one{value}, again;
    const auto of = [](One& o) { return [&o](ParamVisitor& visit) { SEMFIELD_PARAM(visit, o, x, "x"); }; };
    Diagnostics diagnostics;
    read_params(parse_config_text(write_config(params_to_config(of(one))), "t"), "", of(again), diagnostics);
    ASSERT_FALSE(diagnostics.has_errors()) << diagnostics.all()[0].text();
    ASSERT_EQ(std::memcmp(&again.x, &value, sizeof value), 0) << shortest_number(value);
  }
}

TEST(ParamsDescribe, OneRowAParameter) {
  Sample p;
  const std::vector<ParamDoc> docs = describe_params(describer(p));
  ASSERT_EQ(docs.size(), 11u);
  EXPECT_EQ(docs[0].name, "levels");
  EXPECT_EQ(docs[0].type, "int");
  EXPECT_EQ(docs[0].default_value, "16");
  EXPECT_EQ(docs[0].range, "[1, 32]");
  EXPECT_EQ(docs[0].help, "L, number of resolutions");
  EXPECT_EQ(docs[1].range, ">= 0");
  EXPECT_EQ(docs[2].range, "[0, 255]");
  EXPECT_EQ(docs[3].range, "[1, 2.5]");
  EXPECT_EQ(docs[4].range, "");  // the limits of float are no news
  EXPECT_EQ(docs[6].default_value, "data/room");
  EXPECT_EQ(docs[7].type, "choice");
  EXPECT_EQ(docs[7].choices, (std::vector<std::string>{"linear", "smoothstep"}));
  EXPECT_EQ(docs[9].type, "list of number");
  EXPECT_EQ(docs[9].default_value, "[0.9, 0.999]");
  EXPECT_EQ(docs[10].default_value, "[]");
}

}  // namespace
}  // namespace semfield
