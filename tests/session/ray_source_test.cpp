// Which pixels per step takes: fractions, order within tiles, independence of threads.
#include "session/ray_source.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <numeric>
#include <set>

#include "compute/parallel.h"
#include "core/rng.h"
#include "scene/scene.h"
#include "tests/says.h"

namespace semfield {
namespace {

struct Fixture {
  FrameBuffer a, b;
  StoredFrame stored_a, stored_b;
  TrainingLabels::Frame labels_a;
  RayLimits limits;

  Fixture() {
    a.width_px = b.width_px = 8;
    a.height_px = b.height_px = 4;
    a.rgb.assign(96, 0);
    b.rgb.assign(96, 255);
    a.label.assign(32, kVoid);
    b.label.assign(32, kVoid);
    a.label[5] = 1;
    b.label[9] = 0;  // frame b's labels are not selected
  }
  RaySource make(RaySourceOptions options) {
    RayCamera camera{.camera = {.width_px = 8, .height_px = 4, .fx = 4, .fy = 4, .cx = 4, .cy = 2}};
    stored_a = StoredFrame(a);
    stored_b = StoredFrame(b);
    labels_a.hard = stored_a.label;
    return RaySource({{camera, &stored_a, &labels_a}, {camera, &stored_b, nullptr}}, {0, 1}, limits, options);
  }
};

TEST(RaySource, AllImagesTakesEveryPixelOfEveryFrameUniformly) {
  Fixture f;
  RaySourceOptions options{.train = {.rays = 6400}};
  const RaySource source = f.make(options);
  std::vector<int> hits(64);
  for (std::int64_t ray = 0; ray < options.train.rays; ++ray) {
    const RaySource::Pixel p = source.choose(0, ray);
    ++hits[p.frame * 32 + p.index];
  }
  double chi2 = 0;
  for (const int h : hits) chi2 += (h - 100.0) * (h - 100.0) / 100.0;
  EXPECT_LT(chi2, 110) << "63 degrees of freedom, p = 2e-4";
}

TEST(RaySource, MaskedPixelsAreNeverDrawnAndTheOthersUniformly) {
  Fixture f;
  f.a.used.assign(32, 0);
  f.a.used[3] = f.a.used[31] = 1;  // b has no mask
  for (const RaySourceKind kind : {RaySourceKind::all_images, RaySourceKind::one_image}) {
    RaySourceOptions options{.train = {.rays = 3400, .ray_source = kind}};
    const RaySource source = f.make(options);
    std::vector<int> hits(64);
    for (std::int64_t step = 0; step < 20; ++step) {
      for (std::int64_t ray = 0; ray < 170; ++ray) {
        const RaySource::Pixel p = source.choose(step, ray);
        ++hits[static_cast<std::size_t>(p.frame * 32 + p.index)];
      }
    }
    for (std::size_t i = 0; i < 32; ++i) EXPECT_EQ(hits[i] > 0, i == 3 || i == 31) << i;
    for (std::size_t i = 32; i < 64; ++i) EXPECT_GT(hits[i], 20) << i;
    if (kind == RaySourceKind::all_images) {
      EXPECT_LT(std::max(hits[3], hits[31]), 180) << "of 100";
    }
  }
}

TEST(RaySource, AMaskedPixelHasNoLabelWhoeverGaveItOne) {
  Fixture f;
  f.a.used.assign(32, 1);
  f.a.used[5] = 0;
  const RaySourceOptions balanced{.train = {.rays = 100, .ray_source = RaySourceKind::label_balanced}};
  EXPECT_ERROR(f.make(balanced), "labels.training.none", "label");
}

TEST(RaySource, AlphaIsThatOfThePixelAndUnknownElsewhere) {
  Fixture f;
  RaySourceOptions options{.train = {.rays = 256, .ray_source = RaySourceKind::label_balanced, .labelled_share = 0.25},
                           .targets = {std::string(channel::alpha)}};
  options.train.label_rays_teach_color = false;
  std::vector<std::uint8_t> bytes(32);
  for (std::size_t i = 0; i < bytes.size(); ++i) bytes[i] = static_cast<std::uint8_t>(8 * i);
  f.a.channels = {alpha_channel(8, 4, bytes)};
  const RaySource source = f.make(options);
  BatchBuffers batch;
  source.fill(3, batch);
  const std::vector<float>& alpha = batch.of(channel::alpha);
  int known = 0, unknown = 0, label_only = 0;
  for (std::size_t row = 0; row < alpha.size(); ++row) {
    const bool apart = static_cast<std::int64_t>(row) % batch.tile_rays <
                       batch.label_only[row / static_cast<std::size_t>(batch.tile_rays)];
    const bool of_a = batch.target[3 * row] == 0;
    label_only += apart ? 1 : 0;
    (of_a && !apart ? known : unknown) += 1;
    if (!of_a || apart) {
      EXPECT_EQ(alpha[row], -1) << "a frame without alpha, or a ray that is there for its label";
      continue;
    }
    const std::string place = source.place_of_row(3, static_cast<std::int64_t>(row));
    const int x = std::stoi(place.substr(place.find("x ") + 2)), y = std::stoi(place.substr(place.find("y ") + 2));
    EXPECT_EQ(alpha[row], static_cast<float>(bytes[static_cast<std::size_t>(8 * y + x)]) / 255.0F) << place;
  }
  EXPECT_GT(known, 50);
  EXPECT_GT(unknown, label_only);
  EXPECT_EQ(label_only, 64);
  ASSERT_TRUE(source.pool());
  EXPECT_TRUE(source.pool()->with_alpha);
}

// An executor that draws batches itself lays them out in the same way.
TEST(RaySource, ChannelsHaveOneOrderWhoeverAsksFirst) {
  Fixture f;
  const auto names = [&](std::vector<std::string> targets) {
    BatchBuffers batch;
    RaySourceOptions options{.train = {.rays = 64}};
    options.targets = std::move(targets);
    f.make(options).fill(0, batch);
    std::string all;
    for (const BatchBuffers::Channel& channel : batch.more) all += channel.name + " ";
    return all;
  };
  const std::string camera(channel::camera), alpha(channel::alpha), depth(channel::depth);
  EXPECT_EQ(names({camera, alpha, depth, alpha}), depth + " " + alpha + " " + camera + " ");
  EXPECT_EQ(names({alpha, camera}), alpha + " " + camera + " ");
}

TEST(RaySource, OneImageTakesOneFrameAStep) {
  Fixture f;
  RaySourceOptions options{.train = {.ray_source = RaySourceKind::one_image}};
  const RaySource source = f.make(options);
  std::set<int> frames;
  for (std::int64_t step = 0; step < 20; ++step) {
    const std::int32_t frame = source.choose(step, 0).frame;
    for (std::int64_t ray = 1; ray < 50; ++ray) EXPECT_EQ(source.choose(step, ray).frame, frame);
    frames.insert(frame);
  }
  EXPECT_EQ(frames.size(), 2U);
}

TEST(RaySource, LabelBalancedGivesExactlyItsShareInEveryTileLabelledFirst) {
  Fixture f;
  RaySourceOptions options{.train = {.rays = 128, .ray_source = RaySourceKind::label_balanced, .labelled_share = 0.25},
                           .tile_rays = 32};
  const RaySource source = f.make(options);
  BatchBuffers batch;
  source.fill(7, batch);
  for (int tile = 0; tile < 4; ++tile) {
    int labelled = 0;
    bool ended = false;
    for (int r = 0; r < 32; ++r) {
      const bool has = batch.label[32 * tile + r] != kVoid;
      EXPECT_FALSE(has && ended) << "a labelled ray behind an unlabelled one";
      ended = ended || !has;
      labelled += has ? 1 : 0;
    }
    EXPECT_GE(labelled, 8);  // the fraction; uniform rays add a labelled one now and then
    EXPECT_LE(labelled, 12);
  }
}

TEST(RaySource, LabelsOfUnselectedFramesAreVoid) {
  Fixture f;
  RaySourceOptions options{.train = {.rays = 2000}};
  const RaySource source = f.make(options);
  BatchBuffers batch;
  source.fill(0, batch);
  int ones = 0;
  for (std::size_t r = 0; r < 2000; ++r) {
    EXPECT_NE(batch.label[r], 0);
    ones += batch.label[r] == 1 ? 1 : 0;
    if (batch.label[r] == 1) {
      EXPECT_EQ(batch.target[3 * r], 0.0F);
    }
  }
  EXPECT_GT(ones, 5);
}

TEST(RaySource, ATileHoldsItsLabelledRaysAndThenTheOthersInTheirOrder) {
  Fixture f;
  RaySourceOptions options{.train = {.rays = 1500}, .tile_rays = 1};
  BatchBuffers single, tiled;
  f.make(options).fill(4, single);
  for (const std::int64_t tile_rays : {7, 256, 700, 1500, 4000}) {
    options.tile_rays = tile_rays;
    f.make(options).fill(4, tiled);
    std::vector<std::size_t> order(1500);
    std::iota(order.begin(), order.end(), 0U);
    for (std::int64_t begin = 0; begin < 1500; begin += tile_rays)
      std::stable_partition(order.begin() + begin, order.begin() + std::min<std::int64_t>(begin + tile_rays, 1500),
                            [&](std::size_t ray) { return single.label[ray] != kVoid; });
    for (std::size_t row = 0; row < order.size(); ++row) {
      const std::size_t ray = order[row];
      ASSERT_EQ(tiled.label[row], single.label[ray]) << tile_rays << ", row " << row;
      for (std::size_t i = 0; i < 3; ++i) {
        ASSERT_EQ(tiled.direction[3 * row + i], single.direction[3 * ray + i]) << tile_rays << ", row " << row;
        ASSERT_EQ(tiled.target[3 * row + i], single.target[3 * ray + i]) << tile_rays << ", row " << row;
      }
    }
  }
}

TEST(RaySource, TheBatchDoesNotDependOnThreads) {
  Fixture f;
  RaySourceOptions options{.train = {.rays = 500}};
  const RaySource source = f.make(options);
  BatchBuffers one, two;
  set_thread_count(1);
  source.fill(3, one);
  set_thread_count(3);
  source.fill(3, two);
  set_thread_count(0);
  EXPECT_EQ(one.direction, two.direction);
  EXPECT_EQ(one.target, two.target);
}

TEST(RaySource, NoLabelledPixelIsAnErrorForLabelBalanced) {
  Fixture f;
  f.a.label.assign(32, kVoid);
  RaySourceOptions options{.train = {.ray_source = RaySourceKind::label_balanced}};
  EXPECT_THROW(f.make(options), Error);
}

TEST(RaySource, LabelsThatMayComeAreWaitedFor) {
  Fixture f;
  f.a.label.assign(32, kVoid);
  RaySourceOptions options{.train = {.rays = 64, .label_rays_teach_color = false}};
  RaySource all = f.make(options);
  options.train.ray_source = RaySourceKind::label_balanced;
  options.labels_may_come = true;
  RaySource source = f.make(options);
  BatchBuffers one, two;
  all.fill(3, one);
  source.fill(3, two);
  EXPECT_EQ(one.origin, two.origin) << "as all_images, to the bit";
  EXPECT_EQ(one.direction, two.direction);
  EXPECT_EQ(one.label, two.label);
  EXPECT_TRUE(two.label_only.empty());

  std::vector<std::int16_t> labels(32, kVoid);
  labels[5] = 1;
  f.labels_a.hard = LabelMap(labels);
  source.relabel();
  BatchBuffers three, always;
  source.fill(3, three);
  EXPECT_GE(std::count(three.label.begin(), three.label.end(), 1), 32) << "half of the rays, and chance hits";
  EXPECT_EQ(three.label_only, (std::vector<std::int64_t>{16, 16}));
  options.labels_may_come = false;
  Fixture g;
  g.make(options).fill(3, always);
  EXPECT_EQ(three.origin, always.origin) << "as if the labels had always been there";
  EXPECT_EQ(three.label, always.label);

  f.labels_a.hard = LabelMap(std::vector<std::int16_t>(32, kVoid));
  source.relabel();
  source.fill(3, two);
  EXPECT_EQ(one.origin, two.origin);
}

TEST(Rays, PixelCentresLieAtHalves) {
  RayCamera camera{.camera = {.width_px = 8, .height_px = 4, .fx = 4, .fy = 4, .cx = 4.5, .cy = 2.5}};
  RayLimits limits{.near_m = 1, .far_m = 2};
  double o[3], d[3], nf[2];
  EXPECT_EQ(cast_ray(camera, limits, 4, 2, o, d, nf), 1.0);
  EXPECT_EQ(d[2], 1.0);
  EXPECT_EQ(nf[0], 1.0);
  limits.clip = true;
  limits.bounds = {{-1, -1, 1.25}, {1, 1, 1.5}};
  cast_ray(camera, limits, 4, 2, o, d, nf);
  EXPECT_EQ(nf[0], 1.25);
  EXPECT_EQ(nf[1], 1.5);
  limits.bounds = {{5, 5, 1}, {6, 6, 2}};
  cast_ray(camera, limits, 4, 2, o, d, nf);
  EXPECT_EQ(nf[0], nf[1]) << "a ray that misses the bounds is empty";
}

// The index of labelled pixels against the list that it stands for.
TEST(RaySource, LabelBalancedDrawsFromTheLabelledPixelsInOrder) {
  FrameBuffer frames[3];
  StoredFrame stored[3];
  std::vector<RaySource::Pixel> labelled;
  std::uint64_t next = 0;
  for (std::int32_t f = 0; f < 3; ++f) {
    FrameBuffer& frame = frames[f];
    frame.width_px = 37;
    frame.height_px = 19;
    frame.rgb.assign(37 * 19 * 3, 0);
    for (std::int32_t i = 0; i < 37 * 19; ++i) {
      const float u = uniform01(RandomAddress{3, 0, 4}, next++);
      frame.label.push_back(u < 0.3f && (i < 100 || i > 300) ? 0 : u < 0.5f ? 2 : kVoid);  // class 2 has no logit
      if (frame.label.back() == 0 && f != 1) labelled.push_back({f, i});
    }
    stored[f] = StoredFrame(frame);
  }
  RaySourceOptions options{.train = {.ray_source = RaySourceKind::label_balanced, .labelled_share = 1}, .seed = 9};
  RayCamera camera{.camera = {.width_px = 37, .height_px = 19}};
  const TrainingLabels::Frame labels[3] = {{stored[0].label, {}}, {}, {stored[2].label, {}}};
  const RaySource source(
      {{camera, &stored[0], &labels[0]}, {camera, &stored[1], nullptr}, {camera, &stored[2], &labels[2]}},
      {0, 1, kVoid}, RayLimits{}, options);
  const RandomAddress address{9, 5, stream_id("ray_source/pixel")};
  for (std::int64_t ray = 0; ray < 2000; ++ray) {
    const RaySource::Pixel got = source.choose(5, ray);
    const RaySource::Pixel want = labelled[uniform_below(address, static_cast<std::uint64_t>(ray), labelled.size())];
    ASSERT_EQ(got.frame, want.frame);
    ASSERT_EQ(got.index, want.index);
  }
}

// Class 1 has no logit; a frame of hard labels beside one of soft ones becomes rows of one.
TEST(RaySource, SoftLabelsComeAsRowsOverLogits) {
  Fixture f;
  SoftMap soft(32, 3);
  for (std::size_t i = 0; i < 32; ++i) soft.set_row(i, std::array<float, 3>{0.25F, 0, 0.5F});
  soft.set_row(7, std::array<float, 3>{0, 0, 0});
  f.stored_a = StoredFrame(f.a);
  f.stored_b = StoredFrame(f.b);
  const TrainingLabels::Frame a{{}, soft}, b{f.stored_b.label, {}};
  RayCamera camera{.camera = {.width_px = 8, .height_px = 4, .fx = 4, .fy = 4}};
  RaySourceOptions options{.train = {.rays = 3000}};
  const RaySource source({{camera, &f.stored_a, &a}, {camera, &f.stored_b, &b}}, {0, kVoid, 1}, f.limits, options);
  BatchBuffers batch;
  source.fill(0, batch);
  ASSERT_EQ(batch.more.at(0).cols, 2);
  ASSERT_EQ(batch.view(true).targets.more[channel::soft_label].rows, 3000);
  int soft_rows = 0, hard_rows = 0;
  for (std::size_t r = 0; r < 3000; ++r) {
    const float p = batch.of(channel::soft_label)[2 * r], q = batch.of(channel::soft_label)[2 * r + 1];
    if (batch.label[r] == kVoid) {
      EXPECT_EQ(p + q, 0);
    } else if (batch.target[3 * r] == 0) {
      EXPECT_EQ(batch.label[r], 1);
      EXPECT_EQ(p, 0.25F);
      EXPECT_EQ(q, 0.5F);
      ++soft_rows;
    } else {
      EXPECT_EQ(p, 1);  // frame b's one label is class 0
      EXPECT_EQ(q, 0);
      ++hard_rows;
    }
  }
  EXPECT_NEAR(soft_rows, 3000 * 31 / 64, 120);
  EXPECT_GT(hard_rows, 10);
}

TEST(RaySource, AddedLabelsServePixelsWithoutTheirOwn) {
  Fixture f;
  RaySourceOptions options{.train = {.rays = 256, .ray_source = RaySourceKind::label_balanced, .labelled_share = 1}};
  RaySource source = f.make(options);
  std::vector<std::int16_t> a(32, kVoid), b(32, kVoid);
  a[5] = 0;  // has its own label, 1, which stays
  a[7] = 1;
  b[3] = 0;
  const auto drawn = [&] {
    BatchBuffers batch;
    source.fill(0, batch);
    std::set<std::array<int, 3>> seen;
    for (const BatchBuffers::Choice& c : batch.choices) seen.insert({c.pixel.frame, c.pixel.index, c.label});
    return seen;
  };
  using Seen = std::set<std::array<int, 3>>;
  EXPECT_EQ(drawn(), (Seen{{0, 5, 1}}));
  const std::vector<LabelMap> first{LabelMap(a), LabelMap(b)};
  source.add_labels(first);
  EXPECT_EQ(drawn(), (Seen{{0, 5, 1}, {0, 7, 1}, {1, 3, 0}}));
  const std::vector<LabelMap> second{LabelMap(), LabelMap(b)};
  source.add_labels(second);
  EXPECT_EQ(drawn(), (Seen{{0, 5, 1}, {1, 3, 0}})) << "the later ones replace the earlier";
}

TEST(RaySource, AddedLabelsBesideSoftOnesAreSure) {
  Fixture f;
  RaySourceOptions options{.train = {.rays = 64, .ray_source = RaySourceKind::label_balanced, .labelled_share = 1}};
  (void)f.make(options);
  f.labels_a.hard = {};
  f.labels_a.soft = SoftMap(32, 2);
  f.labels_a.soft.set_row(5, std::array<float, 2>{0.25F, 0.5F});
  RayCamera camera{.camera = {.width_px = 8, .height_px = 4, .fx = 4, .fy = 4}};
  RaySource source({{camera, &f.stored_a, &f.labels_a}, {camera, &f.stored_b, nullptr}}, {0, 1}, f.limits, options);
  std::vector<std::int16_t> a(32, kVoid), b(32, kVoid);
  a[7] = b[3] = 0;  // beside the soft label, and in a frame without labels
  const std::vector<LabelMap> added{LabelMap(a), LabelMap(b)};
  source.add_labels(added);
  BatchBuffers batch;
  source.fill(0, batch);
  ASSERT_EQ(batch.more.at(0).cols, 2);
  int sure = 0;
  for (std::size_t ray = 0; ray < 64; ++ray) {  // all are labelled, so rows keep the order of rays
    const TrainPixel pixel = batch.choices[ray].pixel;
    const bool own = pixel.frame == 0 && pixel.index == 5;
    EXPECT_EQ(batch.of(channel::soft_label)[2 * ray], own ? 0.25F : 1);
    EXPECT_EQ(batch.of(channel::soft_label)[2 * ray + 1], own ? 0.5F : 0);
    sure += pixel.index == 7 ? 1 : 0;
  }
  EXPECT_GT(sure, 0);
}

}  // namespace
}  // namespace semfield
