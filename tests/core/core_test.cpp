// Words, digests, findings and arenas.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>

#include "core/error.h"
#include "core/text.h"
#include "core/workspace.h"
#include "system/checksum.h"
#include "tests/says.h"

namespace semfield {
namespace {

// Words, lines and numbers of text files.

TEST(Words, AnyBlanksSeparate) {
  EXPECT_EQ(words_of("  a\tbc  d \r"), (std::vector<std::string_view>{"a", "bc", "d"}));
  EXPECT_TRUE(words_of(" \t").empty());
  EXPECT_TRUE(words_of("").empty());
}

TEST(Words, LinesWithEitherEnd) {
  std::string_view text = "a\r\n\nb c", line;
  std::vector<std::string_view> lines;
  while (next_line(text, line)) lines.push_back(line);
  EXPECT_EQ(lines, (std::vector<std::string_view>{"a", "", "b c"}));
}

TEST(Words, NumbersAreWholeWords) {
  double v = 7;
  EXPECT_TRUE(parse_number("-1.5e2", v));
  EXPECT_EQ(v, -150);
  EXPECT_TRUE(parse_number("+2", v));
  EXPECT_EQ(v, 2);
  EXPECT_TRUE(parse_number("-inf", v));
  EXPECT_EQ(v, -INFINITY);
  EXPECT_TRUE(parse_number("nan", v));
  EXPECT_TRUE(std::isnan(v));
  v = 7;
  for (const char* bad : {"", "x", "1x", "+-1", "1 ", "0x10", "1,5", "1e999"})
    EXPECT_FALSE(parse_number(bad, v)) << bad;
  EXPECT_EQ(v, 7);
}

TEST(Words, CharactersOfUtf8) {
  const std::string_view text = "a\xC3\xA9\xE2\x82\xAC\xF0\x9F\x98\x80";
  EXPECT_EQ(utf8_length(text, 0), 1u);
  EXPECT_EQ(utf8_length(text, 1), 2u);
  EXPECT_EQ(utf8_length(text, 3), 3u);
  EXPECT_EQ(utf8_length(text, 6), 4u);
  for (const char* bad : {"\x96", "\xC3", "\xC0\xAF", "\xED\xA0\x80", "\xF5\x80\x80\x80"})
    EXPECT_EQ(utf8_length(bad, 0), 0u);
}

TEST(Words, AShellReadsAShellWordAsTheText) {
  EXPECT_EQ(shell_word("runs/room_2,a=b"), "runs/room_2,a=b");
  EXPECT_EQ(shell_word(""), "''");
  for (const std::string text : {"a b's", "it's", "$HOME `id` \"x\" \\ !", "*", "~", "a\nb", "-x y", "\xC3\xA9"}) {
    FILE* const shell = popen(("printf %s " + shell_word(text)).c_str(), "r");
    std::string read;
    for (int c = std::fgetc(shell); c != EOF; c = std::fgetc(shell)) read += static_cast<char>(c);
    EXPECT_EQ(pclose(shell), 0);
    EXPECT_EQ(read, text);
  }
}

// SHA-256 against the published examples, and against itself cut into pieces.

std::string digest(std::string_view text) {
  Sha256 sum;
  sum.add(std::as_bytes(std::span(text)));
  return sum.hex();
}

TEST(Sha256, PublishedExamples) {
  EXPECT_EQ(digest(""), "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
  EXPECT_EQ(digest("abc"), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
  EXPECT_EQ(digest("abcdbcdecdefdefgefghfghighijhijkijkljklmklmnlmnomnopnopq"),
            "248d6a61d20638b8e5c026930c3e6039a33ce45964ff2167f6ecedd419db06c1");
  EXPECT_EQ(digest(std::string(1000000, 'a')), "cdc76e5c9914fb9281a1c7e284d73e67f1809a48a497200e046d39ccc7112cd0");
}

TEST(Sha256, PiecesDoNotMatter) {
  const std::string text(200, 'x');
  for (std::size_t size = 0; size <= text.size(); ++size) {
    Sha256 sum;
    for (std::size_t at = 0; at < size; at += 7)
      sum.add(std::as_bytes(std::span(text)).subspan(at, std::min<std::size_t>(7, size - at)));
    EXPECT_EQ(sum.hex(), digest(text.substr(0, size))) << size;
  }
}

// Findings as people read them: the same trouble of many places is one line.

std::vector<std::string> lines(const Diagnostics& d) {
  std::vector<std::string> out;
  for (const Diagnostic& finding : folded(d)) out.push_back(finding.text());
  return out;
}

TEST(Diagnostics, TheSameTroubleOfManyPlacesIsOneLine) {
  Diagnostics d;
  d.error("test.finding.made", "classes.yaml", "no classes in it", "write one");
  for (int i = 0; i < 35; ++i) {
    const std::string n = std::to_string(i), file = "/my data/it's/rgb_" + n + ".png";
    d.error("test.finding.made", "frame 'rgb_" + n + "' (" + file + ")", "colour image '" + file + "' is missing",
            "restore it");
    d.warning("test.finding.made", "/my data/transforms.json: frame " + n + " (rgb (" + n + ").png)",
              "pose is 0.0" + n + " off", {});
  }
  d.error("test.finding.made", "frame 'x' (x.png)", "colour image 'a/x.png' is missing", "take another");
  EXPECT_EQ(lines(d), (std::vector<std::string>{
                          "classes.yaml: no classes in it; write one",
                          "frame 'rgb_0' (/my data/it's/rgb_0.png): colour image '/my data/it's/rgb_0.png' is missing; "
                          "restore it (and 34 more like this: frame 'rgb_1', frame 'rgb_2', frame 'rgb_3', frame "
                          "'rgb_4', ...)",
                          "/my data/transforms.json: frame 0 (rgb (0).png): pose is 0.00 off (and 34 more like this: "
                          "transforms.json: frame 1, transforms.json: frame 2, transforms.json: frame 3, "
                          "transforms.json: frame 4, ...)",
                          "frame 'x' (x.png): colour image 'a/x.png' is missing; take another"}));
  EXPECT_EQ(d.all().size(), 72u);
}

TEST(Diagnostics, WhatOnePlaceSaysTwiceIsKeptUnlessItIsTheSame) {
  Diagnostics d;
  d.error("test.finding.made", "classes.yaml", "id 3 is there twice", "keep one");
  d.error("test.finding.made", "classes.yaml", "id 5 is there twice", "keep one");
  d.error("test.finding.made", "classes.yaml", "id 5 is there twice", "keep one");
  d.error("test.finding.made", "room.yaml:3:5", "unknown key 'a'", {});
  d.error("test.finding.made", "room.yaml:4:5", "unknown key 'b'", {});
  EXPECT_EQ(lines(d), (std::vector<std::string>{"classes.yaml: id 3 is there twice; keep one",
                                                "classes.yaml: id 5 is there twice; keep one",
                                                "room.yaml:3:5: unknown key 'a'", "room.yaml:4:5: unknown key 'b'"}));
}

TEST(Diagnostics, AnExceptionListsThemFolded) {
  Diagnostics d;
  d.warning("test.finding.made", "frame '0'", "is dark", {});
  for (int i = 0; i < 3; ++i)
    d.error("test.finding.made", "frame '" + std::to_string(i) + "'", "is black", "expose longer");
  EXPECT_EQ(error_of([&] { d.throw_if_errors(ErrorKind::data, "problems:"); }),
            "problems:\nframe '0': is black; expose longer (and 2 more like this: frame '1', frame '2')");
}

TEST(Codes, StandBehindTheSentenceWherePeopleReadIt) {
  EXPECT_EQ(shown(Error(ErrorKind::data, "scene.pose.mirrored", "pose mirrors", "flip an axis").while_doing("reading")),
            "reading: pose mirrors; flip an axis [scene.pose.mirrored]");
  EXPECT_EQ(shown(Error(ErrorKind::no_input, "scene.poses.missing", "COLMAP finds poses:\ncolmap mapper --x y")),
            "COLMAP finds poses: [scene.poses.missing]\ncolmap mapper --x y");
  Diagnostics d;
  d.error("scene.image.size", "frame 'a'", "is small", "take another");
  d.error("scene.pose.rotation", "frame 'b'", "is no rotation", {});
  EXPECT_EQ(d.all()[1].shown(), "frame 'b': is no rotation [scene.pose.rotation]");
  try {
    d.throw_if_errors(ErrorKind::data, "problems:");
    FAIL();
  } catch (Error& e) {
    EXPECT_EQ(e.code(), Code("scene.image.size")) << "that of the first";
    e.while_doing("opening");
    EXPECT_EQ(shown(e),
              "opening: problems:\nframe 'a': is small; take another [scene.image.size]\n"
              "frame 'b': is no rotation [scene.pose.rotation]");
  }
}

TEST(Codes, FindingsOfTwoCodesAreNotFolded) {
  Diagnostics d;
  d.error("scene.image.size", "frame '0'", "is black", "expose longer");
  d.error("scene.image.kind", "frame '1'", "is black", "expose longer");
  EXPECT_EQ(folded(d).size(), 2u);
}

TEST(Codes, AreReadFromTextOnlyWhereTheyAreSome) {
  EXPECT_STREQ(Code::parse(std::string("run.folder.busy"))->text(), "run.folder.busy");
  EXPECT_EQ(Code::parse("run.folder.busy"), Code::parse("run.folder.busy"));
  for (const char* none : {"", "run", "run.", ".run", "run..folder", "Run.folder", "run folder.busy", "a.b.c.d.e"})
    EXPECT_FALSE(Code::parse(none)) << none;
}

TEST(Spelling, PartsInCommonCountOnlyWhereAsked) {
  const std::vector<std::string> known{"label_path", "file_path"};
  EXPECT_EQ(did_you_mean("normal_path", known), "label_path");
  EXPECT_EQ(closest_spelling("normal_path", known), "");
  EXPECT_EQ(closest_spelling("lable_path", known), "label_path");
}

// The bump arena: one block in the steady state, and memory that is refused.

constexpr std::size_t kMega = std::size_t{1} << 20;

// A device whose memory is counted and may run out.
std::size_t g_left = 0;
std::int64_t g_blocks = 0;
std::byte* give(std::size_t bytes) {
  if (bytes > g_left) throw Error(ErrorKind::unavailable, "test.error.made", "no memory");
  ++g_blocks;
  return static_cast<std::byte*>(std::aligned_alloc(256, bytes));
}
void take_back(std::byte* block) {
  --g_blocks;
  std::free(block);
}
constexpr BlockSource kSource{Device::cuda, give, take_back};

TEST(Workspace, MergesItsBlocksWhenNothingIsInUse) {
  Workspace arena;
  for (int step = 0; step < 3; ++step) {
    const Workspace::Scope scope(arena);
    const std::int64_t growths = arena.growth_count();
    for (int i = 0; i < 8; ++i) std::fill_n(arena.take_bytes(kMega), kMega, std::byte{1});
    if (step > 0) {
      EXPECT_EQ(arena.growth_count(), growths);
    }
  }
  EXPECT_GE(arena.reserved_bytes(), arena.high_water_bytes());
}

TEST(Workspace, AMergeThatIsRefusedIsToldByTheNextTake) {
  g_left = 64 * kMega;
  {
    Workspace arena(kSource);
    {
      const Workspace::Scope scope(arena);
      for (int i = 0; i < 8; ++i) arena.take_bytes(kMega);
      g_left = kMega;  // a neighbour took the rest
    }
    EXPECT_EQ(arena.reserved_bytes(), 0U);
    EXPECT_THROW(arena.take_bytes(64), Error);
    g_left = 64 * kMega;
    const Workspace::Scope scope(arena);
    for (int i = 0; i < 8; ++i) arena.take_bytes(kMega);
    EXPECT_EQ(g_blocks, 1);
  }
  EXPECT_EQ(g_blocks, 0);
}

TEST(Workspace, ForgetGivesEverythingBack) {
  g_left = 64 * kMega;
  Workspace arena(kSource);
  {
    const Workspace::Scope scope(arena);
    arena.take_bytes(8 * kMega);
  }
  arena.forget();
  EXPECT_EQ(g_blocks, 0);
  EXPECT_EQ(arena.high_water_bytes(), 0U);
  const Workspace::Scope scope(arena);
  arena.take_bytes(64);
  EXPECT_LE(arena.reserved_bytes(), 2 * kMega);
}

}  // namespace
}  // namespace semfield
