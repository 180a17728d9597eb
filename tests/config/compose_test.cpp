// Composition: include, merge, replace-on-type-change, overrides, like, paths.
#include "config/compose.h"

#include "config_testing.h"
#include "system/files.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;

ConfigNode parse(const std::string& yaml) { return parse_config_text(yaml, "t.yaml"); }
std::string merged(const std::string& base, const std::string& over) {
  return write_config_inline(merge_config(parse(base), parse(over)));
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

TEST(Merge, LeavesItsArgumentsAlone) {
  const ConfigNode base = parse("{a: {b: 1}}"), over = parse("{a: {b: 2}}");
  merge_config(base, over);
  EXPECT_EQ(write_config_inline(base), "{a: {b: 1}}");
  EXPECT_EQ(write_config_inline(over), "{a: {b: 2}}");
}

TEST(Compose, IncludesThenLocalKeysThenOverrides) {
  const TempDir folder;
  folder.write("parts/base.yaml", "train: {steps: 10, rate: 0.1}\nscene: {root: data}\n");
  folder.write("parts/more.yaml", "include: base.yaml\ntrain: {rate: 0.2}\n");
  folder.write("parts/last.yaml", "train: {batch: 64}\nscene: {root: other}\n");
  const std::string path =
      folder.write("room.yaml", "include: [parts/more.yaml, parts/last.yaml]\ntrain: {batch: 32}\n");
  const ConfigNode root = compose_config(path, {"train.steps=20", "runtime.seed=7"});
  EXPECT_EQ(write_config_inline(root),
            "{train: {steps: 20, rate: 0.2, batch: 32}, scene: {root: other}, runtime: {seed: 7}}");
  EXPECT_EQ(root.find("train")->find("steps")->location().text(), "--set train.steps=20");
  EXPECT_EQ(root.find("train")->find("rate")->location().text(), folder / "parts/more.yaml" + ":2:15");
  EXPECT_EQ(root.find("train")->find("batch")->location().text(), path + ":2:16");
}

TEST(Compose, SameFileTwiceIsNoCycle) {
  const TempDir folder;
  folder.write("base.yaml", "a: 1\n");
  folder.write("left.yaml", "include: base.yaml\nb: 1\n");
  folder.write("right.yaml", "include: base.yaml\nc: 1\n");
  EXPECT_EQ(write_config_inline(compose_config(folder.write("room.yaml", "include: [left.yaml, right.yaml]\n"))),
            "{a: 1, b: 1, c: 1}");
}

TEST(Compose, RefusesMissingAndCyclicIncludes) {
  const TempDir folder;
  const std::string missing = folder.write("missing.yaml", "train: {}\ninclude: [parts/x.yaml]\n");
  EXPECT_EQ(refusal([&] { compose_config(missing); }),
            missing + ":2:11: include: no file 'parts/x.yaml' (looked for '" + folder / "parts/x.yaml" + "' and '" +
                shared_root() + "/configs/parts/x.yaml'); paths in a config are relative to the file that wrote them");
  const std::string old = folder.write("old.yaml", "include: parts/hash_room.yaml\n");
  EXPECT_HAS(refusal([&] { compose_config(old); }), "no file 'parts/hash_room.yaml'",
             "the preset is called presets/room.yaml now");
  const std::string a = folder.write("a.yaml", "include: sub/b.yaml\n");
  const std::string b = folder.write("sub/b.yaml", "x: 1\ninclude: ../a.yaml\n");
  EXPECT_EQ(refusal([&] { compose_config(a); }),
            b + ":2:10: include: '../a.yaml' includes itself: " + a + " -> " + b + " -> " + a);
  const std::string self = folder.write("self.yaml", "include: ./self.yaml\n");
  EXPECT_EQ(refusal([&] { compose_config(self); }),
            self + ":1:10: include: './self.yaml' includes itself: " + self + " -> " + self);
  const std::string odd = folder.write("odd.yaml", "include: [{a: 1}]\n");
  EXPECT_EQ(refusal([&] { compose_config(odd); }), odd + ":1:11: include: expected a file name, got a map");
  const std::string empty = folder.write("empty.yaml", "include:\na: 1\n");
  EXPECT_EQ(refusal([&] { compose_config(empty); }), empty + ":1:1: include: expected a file name, got nothing");
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

TEST(Compose, AnUnknownConfigurationNamesBothPlacesAndTheNearest) {
  const auto said = [](const std::string& name) {
    try {
      return find_config(name);
    } catch (const Error& error) {
      EXPECT_EQ(error.kind(), ErrorKind::no_input);
      return std::string(error.what());
    }
  };
  const std::string configs = shared_root() + "/configs/";
  EXPECT_EQ(said("qickstart"), "no configuration 'qickstart' (looked for 'qickstart' and '" + configs +
                                   "qickstart'); did you mean 'quickstart'?");
  EXPECT_EQ(said("presets/rom.yaml"), "no configuration 'presets/rom.yaml' (looked for 'presets/rom.yaml' and '" +
                                          configs + "presets/rom.yaml'); did you mean 'presets/room.yaml'?");
  EXPECT_EQ(said("xyz.yaml"),
            "no configuration 'xyz.yaml' (looked for 'xyz.yaml' and '" + configs + "xyz.yaml'); check the path");
  const TempDir folder;
  folder.write("my_room.yaml", "{}");
  EXPECT_EQ(said(folder / "my_rom.yaml"),
            "no configuration '" + folder / "my_rom.yaml" + "'; did you mean '" + folder / "my_room.yaml" + "'?");
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
  EXPECT_TRUE(std::filesystem::exists(shared_file("scenes/room/room.obj")));
}

TEST(Compose, RefusesIncludesThatMultiply) {
  const TempDir folder;
  folder.write("f0.yaml", "a: 1\n");
  for (int i = 1; i <= 20; ++i) {
    const std::string below = "f" + std::to_string(i - 1) + ".yaml";
    folder.write("f" + std::to_string(i) + ".yaml", "include: [" + below + ", " + below + "]\n");
  }
  const std::string message = refusal([&] { compose_config(folder / "f20.yaml"); });
  EXPECT_TRUE(message.ends_with("include: more than 256 files or 32 levels")) << message;
}

TEST(Compose, TopMustBeAMap) {
  const TempDir folder;
  const std::string list = folder.write("list.yaml", "# passes\n- a\n- b\n");
  EXPECT_EQ(refusal([&] { compose_config(list); }), list + ":2:1: expected a map of sections at the top, got a list");
  const std::string word = folder.write("word.yaml", "train steps 10\n");
  EXPECT_EQ(refusal([&] { compose_config(word); }),
            word + ":1:1: expected a map of sections at the top, got 'train steps 10'");
  EXPECT_EQ(write_config_inline(compose_config(folder.write("empty.yaml", ""))), "{}");
  const std::string null = folder.write("null.yaml", "~\n");
  EXPECT_EQ(refusal([&] { compose_config(null); }), null + ":1:1: expected a map of sections at the top, got nothing");
}

class Overrides : public testing::Test {
 protected:
  const TempDir folder_;
  const std::string path_ = folder_.write(
      "room.yaml",
      "train: {steps: 10}\npasses:\n  - {name: coarse, encoder: {type: hash_grid, levels: 8}}\n  - {name: fine}\n"
      "empty:\nnone: []\n");
  std::string set(const std::vector<std::string>& overrides) const {
    return write_config_inline(compose_config(path_, overrides));
  }
  std::string refused(const std::string& text) const {
    return refusal([&] { set({text}); });
  }
};

TEST_F(Overrides, ValuesAreYaml) {
  EXPECT_TRUE(set({"train.betas=[0.9, 0.99]"}).starts_with("{train: {steps: 10, betas: [0.9, 0.99]}"));
  EXPECT_TRUE(set({"train={rate: 1e-3}"}).starts_with("{train: {steps: 10, rate: 1e-3}"));
  EXPECT_TRUE(set({"train.note='a=b.c'"}).starts_with("{train: {steps: 10, note: \"a=b.c\"}"));
  EXPECT_TRUE(set({"train.note=a=b.c"}).starts_with("{train: {steps: 10, note: a=b.c}"));
  EXPECT_TRUE(set({"train.steps="}).starts_with("{train: {steps: null}"));
  EXPECT_TRUE(set({"train.steps=1", "train.steps=2"}).starts_with("{train: {steps: 2}"));
  EXPECT_TRUE(set({"a.b.c=1"}).ends_with("a: {b: {c: 1}}}"));
  EXPECT_HAS(set({"empty.x=1"}), "empty: {x: 1}");
}

TEST_F(Overrides, ListItemsByIndex) {
  EXPECT_HAS(set({"passes.0.encoder.levels=4"}), "{name: coarse, encoder: {type: hash_grid, levels: 4}}");
  EXPECT_HAS(set({"passes.1.samples=3"}), "{name: fine, samples: 3}");
}

TEST_F(Overrides, ListItemsByName) {
  for (const char* key : {"encoder.levels=4", "encoder.type=frequency", "encoder={type: frequency, frequencies: 4}"})
    EXPECT_EQ(set({"passes.coarse." + std::string(key)}), set({"passes.0." + std::string(key)})) << key;
  EXPECT_EQ(set({"passes.fine.samples=3"}), set({"passes.1.samples=3"}));
  // A pass that an override names is called by its new name from there on.
  EXPECT_EQ(set({"passes.fine.name=last", "passes.last.samples=3"}), set({"passes.1.samples=3", "passes.1.name=last"}));
}

// What messages call a pass that is given no name.
TEST(Names, OfPassesWithoutOneAndOfBranches) {
  const TempDir folder;
  const std::string path = folder.write("room.yaml",
                                        "passes:\n"
                                        "  - {n: 1, semantic: [{labels: few, n: 1}, {labels: any, n: 1}]}\n"
                                        "  - {name: a.b, n: 1}\n"
                                        "  - {name: '2', n: 1}\n"
                                        "  - {n: 1, losses: [{type: x, n: 1}]}\n");
  const ConfigNode passes = *compose_config(path).find("passes");
  // A name with a dot, and one that looks like an index, are no keys.
  const char* keys[] = {"main", "1", "2", "pass3"};
  for (std::size_t i = 0; i < 4; ++i) {
    EXPECT_EQ(item_key(passes, i), keys[i]);
    EXPECT_EQ(write_config(compose_config(path, {"passes." + std::string(keys[i]) + ".n=2"})),
              write_config(compose_config(path, {"passes." + std::to_string(i) + ".n=2"})));
  }
  EXPECT_EQ(write_config(compose_config(path, {"passes.main.semantic.any.n=2"})),
            write_config(compose_config(path, {"passes.0.semantic.1.n=2"})));
  EXPECT_EQ(item_key(*passes.items()[3].find("losses"), 0), "0");
}

TEST_F(Overrides, ChangedTypeReplacesWhole) {
  EXPECT_HAS(set({"passes.0.encoder.type=frequency"}), "encoder: {type: frequency}");
  EXPECT_HAS(set({"passes.0.encoder.type=hash_grid"}), "encoder: {type: hash_grid, levels: 8}");
  EXPECT_HAS(set({"passes.0.encoder={type: frequency, frequencies: 4}"}), "encoder: {type: frequency, frequencies: 4}");
}

TEST_F(Overrides, RefusesPathsThatLeadNowhere) {
  EXPECT_EQ(refused("train.steps.x=1"),
            "--set train.steps.x=1: 'train.steps' is '10' (" + path_ + ":1:16), it has no key 'x'");
  const std::string expected =
      ": 'passes' is a list (" + path_ + ":3:3): expected an item's name (coarse, fine) or its index (0 to 1), got '";
  EXPECT_EQ(refused("passes.2.name=x"), "--set passes.2.name=x" + expected + "2'");
  EXPECT_EQ(refused("passes.corse.name=x"), "--set passes.corse.name=x" + expected + "corse'; did you mean 'coarse'?");
  EXPECT_EQ(refused("passes.-1.name=x"), "--set passes.-1.name=x" + expected + "-1'");
  EXPECT_EQ(refused("none.0=x"),
            "--set none.0=x: 'none' is a list (" + path_ + ":6:7): expected an item's index, it is empty, got '0'");
  EXPECT_EQ(refused("train"), "--set train: expected KEY=VALUE; for example --set train.steps=1000");
  const std::string dots = "; write sections and keys with dots between: train.steps";
  EXPECT_EQ(refused("=1"), "--set =1: empty key in ''" + dots);
  EXPECT_EQ(refused("train..x=1"), "--set train..x=1: empty key in 'train..x'" + dots);
  EXPECT_EQ(refused("train.=1"), "--set train.=1: empty key in 'train.'" + dots);
  EXPECT_EQ(refused("include=x.yaml"),
            "--set include=x.yaml: include: files are included by a config, not by an override");
  EXPECT_EQ(refused("a=*x"), "--set a=*x: aliases are not allowed (use 'include' or write the value out)");
}

TEST(Like, OwnKeysWinOverTheNamedPass) {
  const TempDir folder;
  const std::string path = folder.write("room.yaml",
                                        "passes:\n"
                                        "  - name: coarse\n    sampler: {type: stratified, samples: 64}\n    field: "
                                        "{type: nerf_mlp, depth: 8, width: 256}\n"
                                        "  - name: fine\n    like: coarse\n    sampler: {type: importance, "
                                        "keep_previous: true}\n    field: {width: 128}\n"
                                        "  - like: fine\n    name: finest\n");
  EXPECT_EQ(
      write_config_inline(*compose_config(path).find("passes")),
      "[{name: coarse, sampler: {type: stratified, samples: 64}, field: {type: nerf_mlp, depth: 8, width: 256}}, "
      "{name: fine, sampler: {type: importance, keep_previous: true}, field: {type: nerf_mlp, depth: 8, width: 128}}, "
      "{name: finest, sampler: {type: importance, keep_previous: true}, field: {type: nerf_mlp, depth: 8, width: "
      "128}}]");
  // An override of the named pass reaches those that are like it.
  EXPECT_HAS(write_config_inline(compose_config(path, {"passes.0.field.depth=4"})),
             "finest, sampler: {type: importance, keep_previous: true}, field: {type: nerf_mlp, depth: 4, "
             "width: 128}");
}

TEST(Like, RefusesUnknownNames) {
  const TempDir folder;
  const std::string wrong = folder.write("a.yaml", "passes:\n  - name: coarse\n  - {name: fine, like: corse}\n");
  EXPECT_EQ(refusal([&] { compose_config(wrong); }),
            wrong + ":3:24: like: no earlier pass named 'corse'; known: coarse; did you mean 'coarse'?");
  const std::string later = folder.write("b.yaml", "passes:\n  - {name: fine, like: coarse}\n  - name: coarse\n");
  EXPECT_EQ(refusal([&] { compose_config(later); }),
            later + ":2:24: like: no earlier pass named 'coarse'; this is the first one with a name");
  const std::string self = folder.write("c.yaml", "passes:\n  - {name: fine, like: fine}\n");
  EXPECT_EQ(refusal([&] { compose_config(self); }),
            self + ":2:24: like: no earlier pass named 'fine'; this is the first one with a name");
  const std::string list = folder.write("d.yaml", "passes:\n  - {name: fine, like: [x]}\n");
  EXPECT_EQ(refusal([&] { compose_config(list); }),
            list + ":2:24: like: expected the name of an earlier pass, got a list");
}

TEST(ResolvePath, RelativeToTheFileThatWroteIt) {
  const TempDir folder;
  folder.write("parts/base.yaml", "scene: {root: ../data/./room, out: /tmp/x/../y}\n");
  const ConfigNode root = compose_config(folder.write("room.yaml", "include: parts/base.yaml\n"), {"mesh=../m.obj"});
  EXPECT_EQ(resolve_path(*root.find("scene")->find("root")), folder / "data/room");
  EXPECT_EQ(resolve_path(*root.find("scene")->find("out")), "/tmp/y");
  EXPECT_EQ(resolve_path(*root.find("mesh")),
            (std::filesystem::current_path() / "../m.obj").lexically_normal().string());
  const ConfigNode here = parse_config_text("root: data", "configs/room.yaml");
  EXPECT_EQ(resolve_path(*here.find("root")), (std::filesystem::current_path() / "configs/data").string());
}

}  // namespace
}  // namespace semfield
