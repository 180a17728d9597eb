// Files under names that another system wrote.
#include "core/text.h"
#include "loading/frame_files.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

// Of each pair the first is the composed form, as Unicode's own table has it.
TEST(UnicodeForms, ComposedCharactersAreTakenApart) {
  for (const auto& [composed, apart] : {std::pair{"caf\u00E9", "cafe\u0301"},
                                        {"\u1EC7", "e\u0323\u0302"},  // two marks: e, dot below, circumflex
                                        {"\u0439\u0451", "\u0438\u0306\u0435\u0308"},        // Cyrillic
                                        {"\u304C\u30D7", "\u304B\u3099\u30D5\u309A"},        // kana
                                        {"\uAC00\uD55C", "\u1100\u1161\u1112\u1161\u11AB"},  // Hangul
                                        {"\u212B", "A\u030A"},
                                        {"\u1F80", "\u03B1\u0313\u0345"}}) {
    EXPECT_EQ(decomposed(composed), apart);
    EXPECT_EQ(decomposed(apart), apart);
  }
  for (const std::string same : {"", "plain-1.png", "\xFF\xC3", "\xE6\x97\xA5\xF0\x9F\x93\xB7"})
    EXPECT_EQ(decomposed(same), same);
}

TEST(FileNames, OfOtherSystems) {
  const std::string folder = fresh_folder("f"), apart = "cafe\u0301", composed = "caf\u00E9";
  for (const char* sub : {"/a", "/both"}) std::filesystem::create_directories(folder + sub + "/" + apart);
  std::filesystem::create_directories(folder + "/both/" + composed);
  plain_write(folder + "/a/" + apart + "/1.png", "x");
  plain_write(folder + "/a\\2.png", "x");
  plain_write(folder + "/both/" + apart + "/1.png", "x");
  FileNames names;
  EXPECT_EQ(names.of(folder + "/a/" + apart + "/1.png"), folder + "/a/" + apart + "/1.png");
  EXPECT_EQ(names.of(folder + "/a/" + composed + "/1.png"), folder + "/a/" + apart + "/1.png");
  EXPECT_EQ(names.of(folder + "\\a\\" + composed + "\\1.png"), folder + "/a/" + apart + "/1.png");
  EXPECT_EQ(names.of(folder + "/a\\2.png"), folder + "/a\\2.png") << "a file of that name";
  EXPECT_EQ(names.of(folder + "/a\\3.png"), folder + "/a/3.png");
  EXPECT_EQ(names.of(folder + "/both/" + composed + "/1.png"), folder + "/both/" + composed + "/1.png")
      << "a folder of that very name is there";
}

}  // namespace
}  // namespace semfield
