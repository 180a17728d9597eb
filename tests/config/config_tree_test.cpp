// The tree: what it takes, where it says things stand, what it refuses, and writing it back.
#include "config/config_tree.h"

#include "config_testing.h"

namespace semfield {
namespace {

ConfigNode parse(const std::string& yaml) { return parse_config_text(yaml, "room.yaml"); }
std::string refused(const std::string& yaml) {
  return refusal([&] { parse(yaml); });
}
std::string times(const std::string& part, int count) {
  std::string out;
  for (int i = 0; i < count; ++i) out += part;
  return out;
}

TEST(ConfigTree, KeepsKindsTextsAndOrder) {
  const ConfigNode root = parse("b: 1\na: [x, 'y', 010]\nc: {d: ~}\ne:\n");
  ASSERT_TRUE(root.is_map());
  ASSERT_EQ(root.entries().size(), 4u);
  EXPECT_EQ(root.entries()[0].first, "b");
  EXPECT_EQ(root.find("b")->text(), "1");
  ASSERT_EQ(root.find("a")->items().size(), 3u);
  EXPECT_FALSE(root.find("a")->items()[0].quoted());
  EXPECT_TRUE(root.find("a")->items()[1].quoted());
  EXPECT_EQ(root.find("a")->items()[2].text(), "010");
  EXPECT_TRUE(root.find("c")->find("d")->is_null());
  EXPECT_TRUE(root.find("e")->is_null());
  EXPECT_EQ(root.find("nothing"), nullptr);
}

TEST(ConfigTree, EveryNodeKnowsItsPlace) {
  const ConfigNode root = parse("scene:\n  root: data\npasses:\n  - name: coarse\n    levels: [1, 22]\nlast:\n");
  EXPECT_EQ(root.find("scene")->key_location().text(), "room.yaml:1:1");
  EXPECT_EQ(root.find("scene")->find("root")->location().text(), "room.yaml:2:9");
  EXPECT_EQ(root.find("scene")->find("root")->key_location().text(), "room.yaml:2:3");
  const ConfigNode& pass = root.find("passes")->items()[0];
  EXPECT_EQ(pass.location().text(), "room.yaml:4:5");
  EXPECT_EQ(pass.find("levels")->items()[1].location().text(), "room.yaml:5:17");
  EXPECT_EQ(root.find("last")->location().text(), "room.yaml:6:1");
}

TEST(ConfigTree, ColumnsCountCharacters) {
  const ConfigNode root = parse("größe: [über, ä, z]\n");
  EXPECT_EQ(root.find("größe")->location().text(), "room.yaml:1:8");
  EXPECT_EQ(root.find("größe")->items()[2].location().text(), "room.yaml:1:18");
}

TEST(ConfigTree, WindowsAndOldMacLineEndsAndByteOrderMark) {
  for (const std::string text : {"a: 1\r\nb: x\r\n", "a: 1\rb: x\r",
                                 "\xEF\xBB\xBF"
                                 "a: 1\nb: x\n"}) {
    const ConfigNode root = parse(text);
    ASSERT_EQ(root.entries().size(), 2u) << text;
    EXPECT_EQ(root.find("a")->location().text(), "room.yaml:1:4");
    EXPECT_EQ(root.find("b")->text(), "x");
    EXPECT_EQ(root.find("b")->location().text(), "room.yaml:2:4");
  }
}

TEST(ConfigTree, EmptyFilesAreEmptyMaps) {
  for (const std::string text : {"", "\n\n", "# only a comment\n", "\xEF\xBB\xBF"}) {
    const ConfigNode root = parse(text);
    EXPECT_TRUE(root.is_map()) << "'" << text << "'";
    EXPECT_TRUE(root.entries().empty());
  }
  EXPECT_TRUE(ConfigNode().is_map());
  EXPECT_EQ(ConfigNode().location().text(), "");
}

TEST(ConfigTree, TopMayBeAnything) {
  EXPECT_TRUE(parse("- a\n- b\n").is_list());
  EXPECT_TRUE(parse("word").is_scalar());
  EXPECT_TRUE(parse("---\na: 1\n...\n").is_map());
}

TEST(ConfigTree, CommandLineValuesHaveLineZero) {
  const ConfigNode value = parse_config_value("{a: [1, x]}", "--set b={a: [1, x]}");
  EXPECT_EQ(value.find("a")->items()[1].location().text(), "--set b={a: [1, x]}");
  EXPECT_TRUE(parse_config_value("", "--set b=").is_null());
  EXPECT_EQ(refusal([] { parse_config_value("[1", "--set b=[1"); }),
            "--set b=[1: a list or a map where a key should stand (is a bracket left open?)");
}

TEST(ConfigTree, CopiesDoNotShareChanges) {
  const ConfigNode one = parse("a: 1\nb: 2\n");
  const ConfigNode two = one.with("a", *one.find("b")).with("c", ConfigNode()).without("b");
  EXPECT_EQ(one.find("a")->text(), "1");
  EXPECT_EQ(write_config(two), "a: 2\nc: {}\n");
}

TEST(ConfigTree, RefusesDuplicateKeys) {
  EXPECT_EQ(refused("a: 1\nb: 2\na: 3\n"),
            "room.yaml:3:1: duplicate key 'a' (first at room.yaml:1:1); keep one of them");
  EXPECT_EQ(refused("x: {a: 1, 'a': 2}\n"),
            "room.yaml:1:11: duplicate key 'a' (first at room.yaml:1:5); keep one of them");
  EXPECT_EQ(refusal([] { parse("x: {a: 1}\ny: {a: 1}\n"); }), "");
}

TEST(ConfigTree, RefusesAnchorsAliasesTagsMergeKeysAndDocuments) {
  EXPECT_EQ(refused("a: &x 1\nb: *x\n"),
            "room.yaml:1:4: anchors are not allowed ('&x'); use 'include' or write the value out");
  EXPECT_EQ(refused("a: &x [*x]\n"),
            "room.yaml:1:4: anchors are not allowed ('&x'); use 'include' or write the value out");
  EXPECT_EQ(refused("a: *x\n"), "room.yaml:1:4: aliases are not allowed (use 'include' or write the value out)");
  EXPECT_EQ(refused("a: !!int 3\n"),
            "room.yaml:1:4: tags are not allowed ('tag:yaml.org,2002:int'); write the plain value");
  EXPECT_EQ(refused("a: !mine {b: 1}\n"), "room.yaml:1:4: tags are not allowed ('!mine'); write the plain value");
  EXPECT_EQ(refused("<<: {a: 1}\n"),
            "room.yaml:1:1: merge keys are not allowed; use 'include' or write the values out");
  EXPECT_EQ(refused("a: 1\n---\nb: 2\n"), "room.yaml:2:1: more than one YAML document; keep one document in a file");
  EXPECT_EQ(refused("- a\nb: 1\n"), "room.yaml:2:1: more than one YAML document; keep one document in a file");
}

TEST(ConfigTree, RefusesKeysThatAreNoWords) {
  EXPECT_EQ(refused("? [a]\n: b\n"),
            "room.yaml:1:3: a list or a map where a key should stand (is a bracket left open?)");
  EXPECT_EQ(refused("~: b\n"), "room.yaml:1:1: a key is missing before ':'");
  EXPECT_EQ(refused("'': b\n"), "room.yaml:1:1: a key must not be empty");
  EXPECT_EQ(refused("? " + times("k", 600) + "\n: b\n"), "room.yaml:1:3: a key longer than 512 bytes");
}

TEST(ConfigTree, SyntaxErrorsNamePlaceAndCause) {
  EXPECT_EQ(refused("a: b: c\n"), "room.yaml:1:5: a ':' where no key can stand (quote texts that contain ': ')");
  EXPECT_EQ(refused("a: @x\n"), "room.yaml:1:4: this character cannot start a value here (quote the text)");
  EXPECT_EQ(refused("a: 'x"), "room.yaml:1:6: a quoted text is not closed");
  EXPECT_EQ(refused("a: 'it''s\nb: 1\n"), "room.yaml:1:4: a quoted text is not closed");
  EXPECT_EQ(refused("a: \"x\\\"\n"), "room.yaml:1:4: a quoted text is not closed");
  EXPECT_EQ(parse("a: 'it''s'\n").find("a")->text(), "it's");
  EXPECT_EQ(parse("a: \"x\\\"\"\n").find("a")->text(), "x\"");
  EXPECT_EQ(refused("a: 1\n]\n"), "room.yaml:2:1: a closing bracket without an opening one");
  EXPECT_EQ(refused("a: - b\n"), "room.yaml:1:4: a '-' where no list item can stand");
  EXPECT_EQ(refused("a: \"\\q\"\n"), "room.yaml:1:7: unknown escape character: q");
}

TEST(ConfigTree, TabsInIndentationAreNamed) {
  EXPECT_EQ(refused("a:\n\tb: 1\n"), "room.yaml:2:3: a tab cannot indent YAML; use spaces");
  EXPECT_EQ(refused("a:\n  b: 1\n\tc: 2\n"), "room.yaml:3:1: a tab cannot indent YAML; use spaces");
  EXPECT_EQ(parse("a: |\n  x\n  \ty\n").find("a")->text(), "x\n\ty\n");
}

TEST(ConfigTree, RefusesBytesThatAreNoText) {
  EXPECT_EQ(refused(std::string("a: 1\nb: \0\n", 10)), "room.yaml:2:4: NUL byte: this is not a text file");
  EXPECT_EQ(refused("a: \x07\n"), "room.yaml:1:4: control character 7; write it as an escape in double quotes");
  EXPECT_EQ(refused("a: \"\\0\"\n"), "room.yaml:1:4: NUL character in a text");
  // Lone continuation, overlong '/', a surrogate, beyond U+10FFFF, cut short, UTF-16 byte order mark.
  for (const std::string bad : {"\x80", "\xC0\xAF", "\xED\xA0\x80", "\xF4\x90\x80\x80", "\xE2\x82",
                                "\xFF\xFE"
                                "a"}) {
    EXPECT_EQ(refused("a: " + bad), "room.yaml:1:4: not valid UTF-8; save the file as UTF-8");
  }
  EXPECT_EQ(parse("a: \"\\u00e9\xF0\x9F\x8F\xA0\"").find("a")->text(), "\xC3\xA9\xF0\x9F\x8F\xA0");
}

TEST(ConfigTree, DepthOf64IsTheLast) {
  EXPECT_TRUE(parse(times("[", 64) + times("]", 64)).is_list());
  EXPECT_EQ(refused(times("[", 65) + times("]", 65)), "room.yaml:1:65: nested deeper than 64 levels");
  std::string deep;
  for (int i = 0; i < 65; ++i) deep += times(" ", i) + "a:\n";
  EXPECT_EQ(refused(deep + times(" ", 65) + "b: 1\n"), "room.yaml:65:65: nested deeper than 64 levels");
}

TEST(ConfigTree, SizeOfOneMebibyteIsTheLast) {
  const std::string comment = "#" + times("x", 1023);
  std::string text;
  for (int i = 0; i < 1024; ++i) text += comment.substr(0, 1023) + "\n";
  ASSERT_EQ(text.size(), std::size_t{1} << 20);
  EXPECT_TRUE(parse(text).is_map());
  EXPECT_EQ(refused(text + "\n"), "room.yaml: larger than 1 MiB; keep big tables in files of their own");
  const TempDir folder;
  const std::string path = folder.write("big.yaml", text + "\n");
  EXPECT_EQ(refusal([&] { parse_config_file(path); }),
            path + ": larger than 1 MiB; keep big tables in files of their own");
}

// Deep nesting, unclosed and self-repeating input must end in a refusal, without exhausting the stack or the test's own
// limit of time.
TEST(ConfigTree, HostileInputIsRefused) {
  std::vector<std::string> hostile = {"[[:", "{foo:", "{foo", "[[", "a: ["};
  for (const std::string part :
       {"[",  "{",   "- ",     "? ", "[[:", "{foo:", "[\"]\",", "{a: ", "&a ", "!a ",    "*a ", "a: [",
        "[?", "[a,", "[[[]],", "|",  "[:",  "{:",    "[-",      ",",    "a: ", "x: y\n", "]",   "\"a\":"}) {
    hostile.push_back(times(part, 100000));
  }
  for (const std::string& text : hostile) {
    const std::string message = refused(text);
    EXPECT_TRUE(message.starts_with("room.yaml")) << text.substr(0, 12) << ": " << message;
  }
  EXPECT_EQ(refused(times("[", 100000)), "room.yaml:1:513: nested deeper than 64 levels");
}

TEST(ConfigTree, MissingFileIsNoInput) {
  EXPECT_HAS(error_of(ErrorKind::no_input, [&] { parse_config_file("/nonexistent/room.yaml"); }),
             "/nonexistent/room.yaml");
}

TEST(ConfigWrite, BlockAndInlineForms) {
  const std::string yaml =
      "scene:\n  type: replica\n  betas: [0.9, 0.999]\npasses:\n  - name: coarse\n    sampler:\n      type: "
      "stratified\n"
      "    tags: []\n  - 7\n  - [1, 2]\n  - - a\n    - b: {}\nnone: null\n";
  EXPECT_EQ(write_config(parse(yaml)), yaml);
  EXPECT_EQ(
      write_config_inline(parse(yaml)),
      "{scene: {type: replica, betas: [0.9, 0.999]}, passes: [{name: coarse, sampler: {type: stratified}, tags: []}, "
      "7, [1, 2], [a, {b: {}}]], none: null}");
  EXPECT_EQ(write_config(ConfigNode()), "{}\n");
}

TEST(ConfigWrite, RoundTripOfTexts) {
  for (const std::string text : {"",
                                 " ",
                                 "010",
                                 "true",
                                 "no",
                                 "null",
                                 "~",
                                 "a: b",
                                 "a #b",
                                 "#b",
                                 "- a",
                                 "-",
                                 "--- a",
                                 "...",
                                 "? a",
                                 "*a",
                                 "&a",
                                 "!a",
                                 "%a",
                                 "@a",
                                 "`a",
                                 "[a",
                                 "a]",
                                 "{a",
                                 "a}",
                                 "a,b",
                                 "a'b",
                                 "a\"b",
                                 "a\\b",
                                 "line\nline\n\n",
                                 "\ttab\t",
                                 " lead",
                                 "trail ",
                                 "1e5",
                                 ".nan",
                                 "../data/x y.png",
                                 "größe",
                                 "\xE2\x80\xA8",
                                 "\xEF\xBB\xBF",
                                 "\xC2\x85",
                                 "\x01\x7F",
                                 "\xF0\x9F\x8F\xA0",
                                 "a:",
                                 ":a",
                                 "10%",
                                 "=",
                                 "<<",
                                 "|",
                                 ">"}) {
    for (const bool in_list : {false, true}) {
      ConfigNode value = ConfigNode::make_scalar(text, true, {});
      if (in_list) value = ConfigNode::make_list({value, ConfigNode::make_list({value}, {})}, {});
      const std::string key = text.empty() ? "empty" : text;
      const ConfigNode root = ConfigNode::make_map({{"k", value}, {key, value}}, {});
      const ConfigNode again = parse(write_config(root));
      EXPECT_TRUE(equal_config(root, again)) << write_config(root);
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

}  // namespace
}  // namespace semfield
