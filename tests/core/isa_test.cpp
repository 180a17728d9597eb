// The choice of an instruction set.
#include "compute/isa.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <iterator>
#include <memory>
#include <sstream>
#include <string>
#include <vector>

#include "core/error.h"
#include "core/text.h"

namespace semfield {
namespace {

std::vector<std::string> words_of(const std::string& text) {
  std::istringstream in(text);
  return {std::istream_iterator<std::string>(in), {}};
}

// What a process says whose environment has SEMFIELD_ISA=`wanted`: this program again, at the test below.
std::string said_with(const std::string& wanted) {
  const std::string self = std::filesystem::read_symlink("/proc/self/exe").string();
  const std::string command =
      "SEMFIELD_ISA=" + shell_word(wanted) + " " + shell_word(self) + " --gtest_filter=Isa.SaysWhatItIsOrWhyNot 2>&1";
  const std::unique_ptr<FILE, int (*)(FILE*)> pipe(popen(command.c_str(), "r"), pclose);
  std::string text;
  std::array<char, 4096> buffer{};
  while (pipe && fgets(buffer.data(), static_cast<int>(buffer.size()), pipe.get()) != nullptr) text += buffer.data();
  const std::size_t at = text.find("isa: ");
  return at == std::string::npos ? text : text.substr(at + 5, text.find('\n', at) - at - 5);
}

// Also a part of the tests below, in a process of its own.
TEST(Isa, SaysWhatItIsOrWhyNot) {
  std::string said;
  try {
    said = isa_name(isa());
    const std::vector<std::string> built = words_of(isas_of_build());
    EXPECT_NE(std::find(built.begin(), built.end(), said), built.end()) << said;
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::config);
    said = error.message() + "; " + error.remedy();
  }
  std::printf("isa: %s\n", said.c_str());
}

TEST(Isa, EveryOneOfTheBuildThatTheProcessorHasIsTakenWhenTheEnvironmentNamesIt) {
  const std::vector<std::string> built = words_of(isas_of_build());
  ASSERT_FALSE(built.empty());
  const std::string best = said_with("");
  EXPECT_NE(std::find(built.begin(), built.end(), best), built.end()) << best;
  bool beyond = false;  // the processor ends at the best
  for (const std::string& name : built) {
    if (name == "amx_emulated") {  // taken where it is asked for and avx512_bf16 is there
      EXPECT_EQ(said_with(name) == name, said_with("avx512_bf16") == "avx512_bf16");
      continue;
    }
    if (beyond) {
      EXPECT_NE(said_with(name).find("is no instruction set that this processor"), std::string::npos) << name;
    } else {
      EXPECT_EQ(said_with(name), name);
    }
    beyond = beyond || name == best;
  }
  EXPECT_TRUE(beyond);
}

TEST(Isa, AnotherWordInTheEnvironmentIsRefusedWithThoseThatThereAre) {
  const std::string said = said_with("avx1024");
  EXPECT_NE(said.find("SEMFIELD_ISA"), std::string::npos) << said;
  EXPECT_NE(said.find("'avx1024'"), std::string::npos) << said;
  EXPECT_NE(said.find(words_of(isas_of_build()).front()), std::string::npos) << said;
}

TEST(Isa, TakesTheBestVariantThatNeedsNoMore) {
  constexpr IsaVariant<int> kOnlyWeakest[] = {{Isa::generic, 1}};
  EXPECT_EQ(best_variant(kOnlyWeakest), 1);
  constexpr IsaVariant<int> kAll[] = {{Isa::generic, 0},     {Isa::avx2, 1},         {Isa::avx512, 2},
                                      {Isa::avx512_bf16, 3}, {Isa::amx_emulated, 4}, {Isa::amx_bf16, 5},
                                      {Isa::build, 6}};
  EXPECT_EQ(best_variant(kAll), static_cast<int>(isa()));
  if (isa() >= Isa::avx512_bf16 && isa() != Isa::build) {
    constexpr IsaVariant<int> kWithout[] = {{Isa::generic, 0}, {Isa::avx2, 1}, {Isa::avx512, 2}};
    EXPECT_EQ(best_variant(kWithout), 2);
  }
}

TEST(Isa, EmulatesTilesOnlyWhenAsked) {
  const char* wanted = std::getenv("SEMFIELD_ISA");
  EXPECT_EQ(isa() == Isa::amx_emulated, wanted != nullptr && std::string_view(wanted) == "amx_emulated");
}

}  // namespace
}  // namespace semfield
