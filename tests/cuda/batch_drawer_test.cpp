// Batches drawn on the device are those that the host fills, bit by bit.
#include "cuda/steps/batch_drawer.h"

#include "core/rng.h"
#include "scene/scene.h"
#include "session/trainer.h"
#include "tests/cuda/device_fixture.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;
using cuda::BatchDrawer;

constexpr int kAhead = 5;

// Frames of several sizes, lenses and channels, with an empty one among them.
struct Frames {
  std::vector<FrameBuffer> buffers{5};
  std::vector<StoredFrame> stored;
  std::vector<TrainingLabels::Frame> labels{5};
  std::vector<RayCamera> cameras{5};
  RayLimits limits;

  explicit Frames(bool with_empty = true, bool with_masks = false) {
    const std::int32_t side = with_empty ? 0 : 6;
    const std::int32_t sizes[5][2] = {{17, 9}, {side, side}, {40, 31}, {8, 8}, {33, 5}};
    for (std::size_t f = 0; f < 5; ++f) {
      FrameBuffer& frame = buffers[f];
      frame.width_px = sizes[f][0];
      frame.height_px = sizes[f][1];
      const auto pixels = static_cast<std::size_t>(frame.width_px * frame.height_px);
      const auto random = [f](std::size_t i, std::uint64_t below) {
        return uniform_below({7, f, stream_id("drawer_test")}, i, below);
      };
      frame.rgb.resize(3 * pixels);
      for (std::size_t i = 0; i < frame.rgb.size(); ++i) frame.rgb[i] = static_cast<std::uint8_t>(random(i, 256));
      frame.label.resize(pixels);
      for (std::size_t i = 0; i < pixels; ++i)
        frame.label[i] = random(i, 10) < 7 ? kVoid : static_cast<std::int16_t>(random(i + 5000, 4));
      if (f != 3) {
        frame.depth_m.resize(pixels);
        for (std::size_t i = 0; i < pixels; ++i) frame.depth_m[i] = static_cast<float>(random(i, 6000)) * 0.001F;
      }
      if (with_masks && f != 3) {  // beside frames with masks, one without
        frame.used.resize(pixels);
        for (std::size_t i = 0; i < pixels; ++i) frame.used[i] = random(i + 9000, 3) > 0 ? 1 : 0;
      }
      std::vector<std::uint8_t> alpha(pixels);
      for (std::size_t i = 0; i < pixels; ++i) alpha[i] = static_cast<std::uint8_t>(random(i + 9000, 256));
      if (f != 0) frame.channels = {alpha_channel(frame.width_px, frame.height_px, alpha)};
      RayCamera& camera = cameras[f];
      camera.camera.width_px = frame.width_px;
      camera.camera.height_px = frame.height_px;
      camera.camera.fx = 21.3 + static_cast<double>(f);
      camera.camera.fy = 20.1;
      camera.camera.cx = 0.5 * frame.width_px + 0.37;
      camera.camera.cy = 0.5 * frame.height_px - 0.21;
      if (f == 2) camera.camera.k1 = -0.21, camera.camera.k2 = 0.05, camera.camera.p1 = 0.003;
      if (f == 4) camera.camera.k1 = 0.3;
      if (f == 3 && with_masks) camera.camera.lens = LensKind::fisheye;
      if (f == 0 && with_masks) camera.camera.lens = LensKind::equirectangular;
      camera.undistort = f != 4;
      const double angle = 0.4 * static_cast<double>(f);
      camera.world_from_camera.r = {
          {{std::cos(angle), 0, std::sin(angle)}, {0, 1, 0}, {-std::sin(angle), 0, std::cos(angle)}}};
      camera.world_from_camera.t = {0.1 * static_cast<double>(f), -0.3, 0.2};
      stored.emplace_back(frame);
    }
    limits.near_m = 0.1;
    limits.far_m = 5;
  }
  RaySource make(const RaySourceOptions& options) {
    std::vector<TrainFrame> frames;
    for (std::size_t f = 0; f < 5; ++f) {
      labels[f].hard = stored[f].label;
      frames.push_back({cameras[f], &stored[f], f == 0 ? nullptr : &labels[f], "frame"});
    }
    return RaySource(std::move(frames), {2, 0, kVoid, 1}, limits, options);
  }
};

template <class T>
std::vector<T> there(View<const T> view) {
  std::vector<T> values(static_cast<std::size_t>(view.size()));
  cuda::download<T>(view.data, values);
  cuda::synchronize();
  return values;
}
template <class T>
void expect_bits(const std::vector<T>& got, const std::vector<T>& want, const char* what) {
  ASSERT_EQ(got.size(), want.size()) << what;
  EXPECT_EQ(std::memcmp(got.data(), want.data(), got.size() * sizeof(T)), 0) << what;
}

void expect_same_batches(const RaySource& source, const PixelPool& pool, BatchDrawer& drawer) {
  BatchBuffers want;
  for (const std::int64_t step : {0, 3, 4, 5, 1234567}) {
    SCOPED_TRACE(step);
    source.fill(step, want);
    drawer.draw(step);
    const RayBatch host = want.view(pool.with_labels), seen = drawer.seen(step);
    const RayBatch got = cuda::BatchLayout(host).in(drawer.batch(step));
    expect_bits(there(got.origin), want.origin, "origin");
    expect_bits(there(got.direction), want.direction, "direction");
    expect_bits(there(got.near_far), want.near_far, "near and far");
    expect_bits(there(got.targets.color), want.target, "colour");
    const View<const float> depth = got.targets.more[channel::depth], seen_depth = seen.targets.more[channel::depth];
    ASSERT_EQ(seen.targets.label.empty(), host.targets.label.empty());
    ASSERT_EQ(seen_depth.empty(), !pool.with_depth);
    ASSERT_EQ(seen.label_only.rows, host.label_only.rows);
    for (std::int64_t t = 0; t < host.label_only.rows; ++t)
      EXPECT_EQ(seen.label_only(t, 0), host.label_only(t, 0)) << t;
    if (!host.targets.label.empty()) {
      expect_bits(there(got.targets.label), want.label, "label");
      EXPECT_EQ(std::memcmp(seen.targets.label.data, want.label.data(), want.label.size() * sizeof(std::int16_t)), 0);
    }
    ASSERT_EQ(got.targets.more[channel::camera].empty(), !pool.with_camera);
    if (pool.with_camera) expect_bits(there(got.targets.more[channel::camera]), want.of(channel::camera), "camera");
    const View<const float> alpha = got.targets.more[channel::alpha], seen_alpha = seen.targets.more[channel::alpha];
    ASSERT_EQ(seen_alpha.empty(), !pool.with_alpha);
    if (pool.with_alpha) {
      const std::vector<float>& wanted = want.of(channel::alpha);
      expect_bits(there(alpha), wanted, "alpha");
      EXPECT_EQ(std::memcmp(seen_alpha.data, wanted.data(), wanted.size() * sizeof(float)), 0);
    }
    if (pool.with_depth) {
      const std::vector<float>& wanted = want.of(channel::depth);
      expect_bits(there(depth), wanted, "depth");
      EXPECT_EQ(std::memcmp(seen_depth.data, wanted.data(), wanted.size() * sizeof(float)), 0);
    }
  }
}

TEST(CudaBatchDrawer, GivesTheBitsOfMaskedFramesAndWideLenses) {
  SEMFIELD_ON_DEVICE(launch);
  for (const RaySourceKind kind :
       {RaySourceKind::all_images, RaySourceKind::one_image, RaySourceKind::label_balanced}) {
    SCOPED_TRACE(static_cast<int>(kind));
    Frames frames(false, true);
    RaySourceOptions options{.train = {.rays = 2500, .ray_source = kind, .labelled_share = 0.3},
                             .targets = {std::string(channel::depth)},
                             .tile_rays = 333};
    RaySource source = frames.make(options);
    const std::optional<PixelPool> pool = source.pool();
    ASSERT_TRUE(pool);
    ASSERT_FALSE(pool->used_before.empty());
    BatchDrawer drawer(*pool, kAhead);
    expect_same_batches(source, *pool, drawer);
  }
}

TEST(CudaBatchDrawer, GivesTheBitsThatTheHostFills) {
  SEMFIELD_ON_DEVICE(launch);
  for (const RaySourceKind kind :
       {RaySourceKind::all_images, RaySourceKind::one_image, RaySourceKind::label_balanced}) {
    for (const bool teach : {true, false}) {
      for (const std::int64_t tile : {32, 333, 3000}) {
        SCOPED_TRACE(::testing::Message() << static_cast<int>(kind) << ' ' << teach << ' ' << tile);
        Frames frames(kind != RaySourceKind::one_image);  // which takes every frame
        frames.limits.z_depth = tile == 32;
        frames.limits.clip = tile == 333;
        frames.limits.bounds = {{-1, -1, -1}, {1.5, 1, 2}};
        RaySourceOptions options{
            .train = {.rays = 2500, .ray_source = kind, .labelled_share = 0.3, .label_rays_teach_color = teach}};
        if (tile != 333) options.targets = {std::string(channel::depth)};
        if (tile != 32) options.targets.emplace_back(channel::camera);
        if (tile != 3000) options.targets.emplace_back(channel::alpha);
        options.seed = 11 + static_cast<std::uint64_t>(tile);
        options.tile_rays = tile;
        RaySource source = frames.make(options);
        const std::optional<PixelPool> pool = source.pool();
        ASSERT_TRUE(pool);
        BatchDrawer drawer(*pool, kAhead);
        expect_same_batches(source, *pool, drawer);
      }
    }
  }
}

TEST(CudaBatchDrawer, TakesNewLabelsOfTheSamePixels) {
  SEMFIELD_ON_DEVICE(launch);
  Frames frames;
  RaySourceOptions options{.train = {.rays = 640, .ray_source = RaySourceKind::label_balanced}};
  RaySource source = frames.make(options);
  BatchDrawer drawer(*source.pool(), kAhead);
  expect_same_batches(source, *source.pool(), drawer);
  const std::uint64_t before = source.version();
  frames.labels[2].hard = LabelMap(std::vector<std::int16_t>(40 * 31, 3));
  frames.labels[4].hard = LabelMap();
  source.relabel();
  EXPECT_NE(source.version(), before);
  ASSERT_TRUE(drawer.relabel(*source.pool()));
  expect_same_batches(source, *source.pool(), drawer);
  Frames others;
  RaySource other = others.make(options);
  EXPECT_FALSE(drawer.relabel(*other.pool()));
}

TEST(CudaBatchDrawer, WhatAHostMustSayIsLeftToIt) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  const Session session = open_text(hash_config() + "runtime: {device: cuda}\n", registry);
  const std::unique_ptr<RaySource> rays = session.make_ray_source();
  Executor<float>& executor = session.pipeline->executor();
  std::optional<PixelPool> pool = rays->pool();
  ASSERT_TRUE(pool);
  EXPECT_TRUE(executor.hold(*pool));
  PixelPool bad_camera = *pool;
  bad_camera.frames.back().camera.cx = NAN;
  EXPECT_FALSE(executor.hold(bad_camera));
  PixelPool bad_label = *pool;
  bad_label.read_labels = [](std::size_t, std::span<std::int16_t>) {
    throw Error(ErrorKind::data, "test.error.made", "no class", "");
  };
  EXPECT_FALSE(executor.hold(bad_label));
}

TEST(CudaBatchDrawer, PixelsThatDoNotFitStayOnTheHostWhichIsSaidOnce) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  const Session session = open_text(hash_config() + "runtime: {device: cuda}\n", registry);
  const std::unique_ptr<RaySource> rays = session.make_ray_source();
  Executor<float>& executor = session.pipeline->executor();
  std::optional<PixelPool> pool = rays->pool();
  ASSERT_TRUE(pool);
  std::vector<std::int64_t> offsets(pool->offsets.begin(), pool->offsets.end());
  offsets.back() = std::int64_t{1} << 40;
  pool->offsets = offsets;
  (void)executor.take_notes();
  EXPECT_FALSE(executor.hold(*pool));
  const std::vector<std::string> notes = executor.take_notes();
  ASSERT_EQ(notes.size(), 1u);
  EXPECT_HAS(notes[0], "pixels stay in the host's memory");
  EXPECT_FALSE(executor.hold(*pool));
  EXPECT_TRUE(executor.take_notes().empty());
}

}  // namespace
}  // namespace semfield
