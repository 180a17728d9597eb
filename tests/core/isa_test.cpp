// The choice of an instruction set.
#include "compute/isa.h"

#include <gtest/gtest.h>

#include <cstdlib>

namespace semfield {
namespace {

TEST(Isa, IsOneOfTheBuildAndObeysTheEnvironment) {
  EXPECT_NE((" " + isas_of_build() + " ").find(" " + std::string(isa_name(isa())) + " "), std::string::npos);
  if (const char* wanted = std::getenv("SEMFIELD_ISA")) {
    EXPECT_EQ(isa_name(isa()), wanted);
  }
}

TEST(Isa, TakesTheBestVariantThatNeedsNoMore) {
  constexpr IsaVariant<int> kOnlyWeakest[] = {{Isa::generic, 1}};
  EXPECT_EQ(best_variant(kOnlyWeakest), 1);
  constexpr IsaVariant<int> kAll[] = {
      {Isa::generic, 0}, {Isa::avx2, 1}, {Isa::avx512, 2}, {Isa::avx512_bf16, 3}, {Isa::build, 4}};
  EXPECT_EQ(best_variant(kAll), static_cast<int>(isa()));
  if (isa() == Isa::avx512_bf16) {
    constexpr IsaVariant<int> kWithout[] = {{Isa::generic, 0}, {Isa::avx2, 1}, {Isa::avx512, 2}};
    EXPECT_EQ(best_variant(kWithout), 2);
  }
}

}  // namespace
}  // namespace semfield
