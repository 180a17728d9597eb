// Vectors that a channel is asked by: their files, and the cosines.
#include "eval/channel_query.h"

#include "formats/image_io.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

TEST(ChannelQuery, WordsComeFromJsonAndVectorsFromNumpy) {
  const TempDir dir;
  dir.write("words.json", R"({"a chair": [1, 0, 2], "lamp": [0, 1, 0]})");
  const std::vector<QueryVector> words = read_queries(dir / "words.json", 3);
  ASSERT_EQ(words.size(), 2U);
  EXPECT_EQ(words[0].name, "a_chair");
  EXPECT_EQ(words[0].values, (std::vector<float>{1, 0, 2}));
  write_npy(dir / "one.npy", std::vector<std::int64_t>{3}, std::vector<float>{1, 2, 3});
  write_npy(dir / "two.npy", std::vector<std::int64_t>{2, 3}, std::vector<float>{1, 2, 3, 4, 5, 6});
  EXPECT_EQ(read_queries(dir / "one.npy", 3)[0].name, "one");
  const std::vector<QueryVector> two = read_queries(dir / "two.npy", 3);
  EXPECT_EQ(two[1].name, "two_1");
  EXPECT_EQ(two[1].values, (std::vector<float>{4, 5, 6}));
}

TEST(ChannelQuery, WrongVectorsAreNamed) {
  const TempDir dir;
  const auto refusal = [](const std::string& path) { return error_of([&] { (void)read_queries(path, 2); }); };
  const auto expect = [&](const std::string& text, const std::string& said) {
    EXPECT_HAS(refusal(dir.write("w.json", text)), said);
  };
  expect("{", "is not JSON");
  expect("[1, 2]", "expected a map from words to vectors");
  expect("{}", "expected a map from words to vectors");
  expect(R"({"chair": 3})", "'chair' is not a list of numbers");
  expect(R"({"chair": [1, "x"]})", "'chair' holds something that is not a number");
  expect(R"({"chair": [1]})", "vector 'chair' has 1 numbers, and the channel 2");
  expect(R"({"chair": [0, 0]})", "vector 'chair' is zero");
  expect(R"({"chair": [1e300, 0]})", "vector 'chair' has a number that is not finite");
  expect(R"({"a b": [1, 0], "a.b": [0, 1]})", "two vectors would be written as 'a_b'");
  write_npy(dir / "deep.npy", std::vector<std::int64_t>{1, 1, 2}, std::vector<float>{1, 2});
  EXPECT_HAS(refusal(dir / "deep.npy"), "has the shape (1, 1, 2)");
  EXPECT_HAS(refusal(dir / "none.npy"), "none.npy");
}

TEST(ChannelQuery, CosinesAreThoseOfTheWholeVector) {
  const FrameChannel map{"clip", 1, 3, 2, {2, 0, 1, 1, 0, 0}};
  const std::vector<float> plain = cosine_map(map, {1, 0}, {});
  EXPECT_FLOAT_EQ(plain[0], 1);
  EXPECT_FLOAT_EQ(plain[1], std::sqrt(0.5F));
  EXPECT_EQ(plain[2], 0) << "a row of zeros";
  // Axes x and z of three columns: half of the vector (1, 1, 0) lies off them.
  const std::vector<float> axes{1, 0, 0, 0, 0, 1};
  const std::vector<float> along = cosine_map(map, {1, 1, 0}, {axes.data(), 3, 2});
  EXPECT_FLOAT_EQ(along[0], std::sqrt(0.5F));
  EXPECT_FLOAT_EQ(along[1], 0.5F);
}

}  // namespace
}  // namespace semfield
