// Rendering without memory for a whole chunk of rays goes on by halves, with the same bits.
#include <cstdlib>

#include "compute/parallel.h"
#include "eval/evaluator.h"
#include "tests/session/train_testing.h"

namespace {

std::atomic<std::size_t> g_most{std::numeric_limits<std::size_t>::max()};  // bytes a request may have
std::atomic<int> g_refused{0};

}  // namespace

// Of this program and the libraries it loads; the standard library's array forms call it. Not inlined: a compiler that
// sees malloc in one half of a pair warns of the other.
[[gnu::noinline]] void* operator new(std::size_t bytes) {
  if (bytes > g_most) {
    ++g_refused;
    throw std::bad_alloc();
  }
  void* const memory = std::malloc(bytes > 0 ? bytes : 1);
  if (memory == nullptr) throw std::bad_alloc();
  return memory;
}
// A sanitizer's own would not call the one above.
void* operator new(std::size_t bytes, const std::nothrow_t&) noexcept { return std::malloc(bytes > 0 ? bytes : 1); }
[[gnu::noinline]] void operator delete(void* memory) noexcept { std::free(memory); }
[[gnu::noinline]] void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }

namespace semfield {
namespace {

using namespace testing_train;

struct Scarce {
  explicit Scarce(std::size_t most) {
    g_refused = 0;
    g_most = most;
  }
  ~Scarce() { g_most = std::numeric_limits<std::size_t>::max(); }
};

TEST(RenderChunk, HalvesUntilItFitsWithTheSameBits) {
  Session s = open_text(hash_config());
  const FrameInfo& info = s.scene.info.frames.front();
  const RayCamera camera{info.camera, info.world_from_camera, true};
  const auto render = [&] { return render_frame(*s.pipeline, camera, s.limits, s.plan.class_of_logit); };
  set_thread_count(1);  // no other thread's first buffers among the requests
  const RenderedFrame whole = render();
  RenderedFrame halved;
  {
    const Scarce scarce(50'000);  // the buffers of 2,048 rays take 49,152 bytes, those of 4,096 twice that
    halved = render();
  }
  EXPECT_EQ(g_refused, 2);  // of 8,192 and of 4,096 rays
  EXPECT_EQ(whole.rgb, halved.rgb);
  EXPECT_EQ(whole.depth_m, halved.depth_m);
  EXPECT_EQ(whole.opacity, halved.opacity);
  EXPECT_EQ(whole.label, halved.label);
  EXPECT_EQ(whole.entropy, halved.entropy);
  EXPECT_EQ(whole.confidence, halved.confidence);
}

TEST(RenderChunk, GivesUpWhenNothingFits) {
  Session s = open_text(hash_config());
  const FrameInfo& info = s.scene.info.frames.front();
  const RayCamera camera{info.camera, info.world_from_camera, true};
  set_thread_count(1);
  (void)render_frame(*s.pipeline, camera, s.limits, s.plan.class_of_logit);
  const Scarce scarce(1'000);
  EXPECT_THROW((void)render_frame(*s.pipeline, camera, s.limits, s.plan.class_of_logit), std::bad_alloc);
}

}  // namespace
}  // namespace semfield
