#include <unistd.h>

#include <array>
#include <cmath>
#include <cstring>
#include <iterator>
#include <memory>
#include <regex>
#include <sstream>

#include "config/config_tree.h"
#include "config/config_words.h"
#include "config/params.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {

enum class Interp { linear, smoothstep };
template <>
struct ChoiceNames<Interp> {
  static constexpr std::array<std::string_view, 2> names{"linear", "smoothstep"};
};

namespace {

/// What the Error(config) says that `body` throws; "" when it throws nothing.
inline std::string refusal(const std::function<void()>& body) { return error_of(ErrorKind::config, body); }

// The tree and writing it back. What it refuses, and where: tests/bad_files/config.cases.

ConfigNode parse(const std::string& yaml) { return parse_config_text(yaml, "room.yaml"); }

TEST(ConfigTree, CopiesDoNotShareChanges) {
  const ConfigNode one = parse("a: 1\nb: 2\n");
  const ConfigNode two = one.with("a", *one.find("b")).with("c", ConfigNode()).without("b");
  EXPECT_EQ(one.find("a")->text(), "1");
  EXPECT_EQ(write_config(two), "a: 2\nc: {}\n");
}

TEST(ConfigWrite, BlockAndInlineForms) {
  const std::string yaml =
      "scene:\n  type: replica\n  betas: [0.9, 0.999]\npasses:\n  - name: coarse\n    sampler:\n"
      "      type: stratified\n    tags: []\n  - 7\n  - [1, 2]\n  - - a\n    - b: {}\nnone: null\n";
  EXPECT_EQ(write_config(parse(yaml)), yaml);
  EXPECT_EQ(
      write_config_inline(parse(yaml)),
      "{scene: {type: replica, betas: [0.9, 0.999]}, passes: [{name: coarse, sampler: {type: stratified}, tags: []}, "
      "7, [1, 2], [a, {b: {}}]], none: null}");
  EXPECT_EQ(write_config(ConfigNode()), "{}\n");
}

TEST(ConfigWrite, RoundTripOfTexts) {
  std::istringstream words(
      "010 true no null ~ #b - ... *a &a !a %a @a `a [a a] {a a} a,b a'b a\"b a\\b 1e5 .nan größe "
      "\xE2\x80\xA8 \xEF\xBB\xBF \xC2\x85 \x01\x7F \xF0\x9F\x8F\xA0 a: :a 10% = << | >");
  std::vector<std::string> texts(std::istream_iterator<std::string>(words), {});
  texts.insert(texts.end(), {"", " ", "a: b", "a #b", "- a", "--- a", "? a", "line\nline\n\n", "\ttab\t", " lead",
                             "trail ", "../data/x y.png"});
  for (const std::string& text : texts) {
    for (const bool in_list : {false, true}) {
      ConfigNode value = ConfigNode::make_scalar(text, true, {});
      if (in_list) value = ConfigNode::make_list({value, ConfigNode::make_list({value}, {})}, {});
      const std::string key = text.empty() ? "empty" : text;
      const ConfigNode root = ConfigNode::make_map({{"k", value}, {key, value}}, {});
      EXPECT_TRUE(equal_config(root, parse(write_config(root)))) << write_config(root);
      EXPECT_TRUE(equal_config(root, parse(write_config_inline(root)))) << write_config_inline(root);
    }
  }
}

TEST(ConfigWrite, RoundTripKeepsQuotesThatMatter) {
  const ConfigNode root = parse(
      "a: [1, '1', true, 'true', word, 'word', ~, '~', -5, +5, .5, 1e-3, 10%]\nb: it's [so]\nc: {}\nd: []\n"
      "e: >\n  folded\n  text\nf: multi\n  line\n010: x\n'null': y\ng: [[], {}, [[1]]]\n");
  EXPECT_TRUE(equal_config(root, parse(write_config(root)))) << write_config(root);
  EXPECT_TRUE(equal_config(root, parse(write_config_inline(root))));
  EXPECT_FALSE(equal_config(parse("a: 1"), parse("a: '1'")));
  EXPECT_TRUE(equal_config(parse("a: word"), parse("a: 'word'")));
  EXPECT_FALSE(equal_config(parse("a: null"), parse("a: 'null'")));
  EXPECT_FALSE(equal_config(parse("a: 1\nb: 2"), parse("b: 2\na: 1")));
  EXPECT_FALSE(equal_config(parse("a: [1]"), parse("a: [1, 2]")));
  EXPECT_EQ(parse("a: |\n  x\n  \ty\n").find("a")->text(), "x\n\ty\n");
  EXPECT_EQ(parse("a: 'it''s'\n").find("a")->text(), "it's");
  EXPECT_EQ(parse("a: \"\\u00e9\xF0\x9F\x8F\xA0\"").find("a")->text(), "\xC3\xA9\xF0\x9F\x8F\xA0");
  EXPECT_TRUE(parse("x: {a: 1}\ny: {a: 1}\n").is_map());
  EXPECT_TRUE(parse(std::string(64, '[') + std::string(64, ']')).is_list()) << "no deeper than is read";
}

TEST(ConfigWrite, PlainTexts) {
  for (const char* plain : {"hash_grid", "data/room_0", "../x", "./x", "a b", "/abs/path"})
    EXPECT_TRUE(is_plain_text(plain)) << plain;
  for (const char* typed : {"1", "-1", "010", "1e5", ".5", "true", "No", "null", "~", ".inf", "-.inf", "10%"}) {
    EXPECT_FALSE(is_plain_text(typed)) << typed;
    EXPECT_TRUE(looks_typed(typed)) << typed;
  }
  EXPECT_FALSE(looks_typed("a: b"));
  EXPECT_FALSE(looks_typed("010 #"));  // needs quotes, so it cannot be a number
  EXPECT_FALSE(is_plain_text("a: b"));
}

// Composition: merging, files by name, paths. Includes, overrides, like, explanations and differences:
// tests/bad_files/config.cases.

ConfigNode compose_parse(const std::string& yaml) { return parse_config_text(yaml, "t.yaml"); }
std::string merged(const std::string& base, const std::string& over) {
  return write_config_inline(merge_config(compose_parse(base), compose_parse(over)));
}

TEST(Merge, MapsMergeListsAndScalarsReplace) {
  EXPECT_EQ(merged("{a: 1, b: {c: 2, d: 3}}", "{b: {d: 4, e: 5}, f: 6}"), "{a: 1, b: {c: 2, d: 4, e: 5}, f: 6}");
  EXPECT_EQ(merged("{a: [1, 2, 3]}", "{a: [4]}"), "{a: [4]}");
  EXPECT_EQ(merged("{a: {b: 1}}", "{a: 2}"), "{a: 2}");
  EXPECT_EQ(merged("{a: 2}", "{a: {b: 1}}"), "{a: {b: 1}}");
  EXPECT_EQ(merged("{a: {b: 1}}", "{a: ~}"), "{a: null}");
  EXPECT_EQ(merged("{a: {b: 1}}", "{a: {}}"), "{a: {b: 1}}");
}

TEST(Merge, ChangedTypeReplacesWhole) {
  EXPECT_EQ(merged("{e: {type: hash_grid, levels: 8}}", "{e: {type: frequency}}"), "{e: {type: frequency}}");
  EXPECT_EQ(merged("{e: {type: hash_grid, levels: 8}}", "{e: {type: hash_grid, features: 2}}"),
            "{e: {type: hash_grid, levels: 8, features: 2}}");
  EXPECT_EQ(merged("{e: {levels: 8}}", "{e: {type: hash_grid}}"), "{e: {levels: 8, type: hash_grid}}");
  EXPECT_EQ(merged("{e: {type: {x: 1}}}", "{e: {type: {y: 1}}}"),
            "{e: {type: {x: 1, y: 1}}}");  // a key called type, no type
}

TEST(Compose, ShippedPartsAreIncludedFromAnyFolder) {
  const TempDir folder;
  const std::string path = folder.write("room.yaml", "include: presets/room.yaml\ntrain: {rays: 7}\n");
  const ConfigNode root = compose_config(path);
  EXPECT_EQ(write_config(root.find("passes")->items().at(0)),
            write_config(compose_config(shared_file("configs/presets/room.yaml")).find("passes")->items().at(0)));
  EXPECT_EQ(root.find("train")->find("rays")->text(), "7");
  // A file of one's own comes first.
  folder.write("presets/room.yaml", "train: {steps: 3}\n");
  EXPECT_EQ(write_config_inline(compose_config(path)), "{train: {steps: 3, rays: 7}}");
}

TEST(Compose, ConfigurationsAreFoundByName) {
  const TempDir folder;
  const fs::path before = fs::current_path();
  fs::current_path(folder / "");  // nothing lies there
  const std::string shipped = shared_file("configs/quickstart.yaml");
  for (const char* name : {"quickstart", "quickstart.yaml", "configs/quickstart.yaml", "configs/quickstart"})
    EXPECT_EQ(find_config(name), shipped) << name;
  EXPECT_EQ(find_config("scenes/../paper"), shared_file("configs/paper.yaml"));
  fs::current_path(before);
  const std::string own = folder.write("quickstart.yaml", "{}");
  EXPECT_EQ(find_config(folder / "quickstart"), own);
  EXPECT_EQ(find_config(own), own);
}

TEST(SharedFiles, TheEnvironmentNamesAnotherFolder) {
  const TempDir folder;
  const std::string part = folder.write("configs/presets/room.yaml", "train: {steps: 5}\n");
  ::setenv("SEMFIELD_SHARE", (folder / "").c_str(), 1);
  EXPECT_EQ(shared_file("configs/presets/room.yaml"), part);
  EXPECT_EQ(find_config("presets/room"), part);
  EXPECT_THROW(shared_file("scenes/room"), Error);
  ::setenv("SEMFIELD_SHARE", (folder / "none").c_str(), 1);
  EXPECT_EQ(refusal([] { shared_root(); }),
            "environment variable SEMFIELD_SHARE: no folder '" + folder / "none" +
                "'; set it to the folder that holds configs/ and scenes/, or leave it out");
  ::unsetenv("SEMFIELD_SHARE");
  EXPECT_TRUE(fs::exists(shared_file("scenes/room/room.obj")));
}

TEST(ResolvePath, RelativeToTheFileThatWroteIt) {
  const TempDir folder;
  folder.write("parts/base.yaml", "scene: {root: ../data/./room, out: /tmp/x/../y}\n");
  const ConfigNode root = compose_config(folder.write("room.yaml", "include: parts/base.yaml\n"), {"mesh=../m.obj"});
  EXPECT_EQ(resolve_path(*root.find("scene")->find("root")), folder / "data/room");
  EXPECT_EQ(resolve_path(*root.find("scene")->find("out")), "/tmp/y");
  EXPECT_EQ(resolve_path(*root.find("mesh")), (fs::current_path() / "../m.obj").lexically_normal().string());
  const ConfigNode here = parse_config_text("root: data", "configs/room.yaml");
  EXPECT_EQ(resolve_path(*here.find("root")), (fs::current_path() / "configs/data").string());
}

// Parameters read from the tree, written back exactly, described. Mistakes: tests/bad_files/config.cases; their schema:
// tests/command_line.

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
  return texts(diagnostics);
}

TEST(ParamsRead, TakesEveryType) {
  Sample p;
  EXPECT_EQ(errors_of("type: x\nlevels: 8\nseed: 9223372036854775807\nsmall: 255\ngrowth: 2\nrate: 1e-3\ndense: true\n"
                      "root: 10%\ninterpolation: smoothstep\nskips: [0, +8]\nbetas: [.5, 1.]\nfiles: [a, 'b c', 3]\n",
                      &p),
            "");
  EXPECT_EQ(write_config(params_to_config(describer(p))),
            "levels: 8\nseed: 9223372036854775807\nsmall: 255\ngrowth: 2.0\nrate: 0.0010000000474974513\ndense: true\n"
            "root: \"10%\"\ninterpolation: smoothstep\nskips: [0, 8]\nbetas: [0.5, 1.0]\nfiles: [a, b c, \"3\"]\n");
}

TEST(ParamsWrite, ResolvedTreeReadsBackTheSame) {
  Sample p{.seed = std::numeric_limits<std::int64_t>::max(), .growth = 0.1 + 0.2 + 1.0, .rate = 1e-5f, .root = "010"};
  p.interpolation = Interp::smoothstep;
  p.betas = {5e-324, 0.1, 1.0};
  p.files = {"true", "a: b", "größe", ""};
  const std::string yaml = write_config(params_to_config(describer(p)));
  Sample q;
  EXPECT_EQ(errors_of(yaml, &q), "") << yaml;
  EXPECT_HAS(yaml, "root: \"010\"\n");  // other YAML readers must see a text, too
  EXPECT_HAS(yaml, "files: [\"true\", \"a: b\", ");
  EXPECT_EQ(write_config(params_to_config(describer(q))), yaml);
  EXPECT_EQ(std::tie(q.growth, q.rate, q.seed), std::tie(p.growth, p.rate, p.seed));
  EXPECT_EQ(std::tie(q.betas, q.files, q.root), std::tie(p.betas, p.files, p.root));
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
  std::string rows;
  for (const ParamDoc& doc : docs)
    rows += doc.name + "|" + doc.type + "|" + doc.default_value + "|" + doc.range + join(doc.choices) + "\n";
  EXPECT_EQ(rows,
            "levels|int|16|[1, 32]\nseed|int|1|>= 0\nsmall|int|3|[0, 255]\ngrowth|number|1.5|[1, 2.5]\n"
            "rate|number|0.25|\n"  // the limits of float are no news
            "dense|bool|false|\nroot|text|data/room|\ninterpolation|choice|linear|linear, smoothstep\n"
            "skips|list of int|[4]|[0, 8]\nbetas|list of number|[0.9, 0.999]|[0, 1]\nfiles|list of text|[]|\n");
  EXPECT_EQ(docs[0].help, "L, number of resolutions");
}

}  // namespace
}  // namespace semfield
