// The bump arena: one block in the steady state, and memory that is refused.
#include "core/workspace.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdlib>

#include "core/error.h"

namespace semfield {
namespace {

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
