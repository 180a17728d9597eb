// Which pixels per step takes: fractions, order within tiles, independence of threads.

#include "train/ray_source.h"

#include <algorithm>
#include <numeric>
#include <ostream>
#include <set>

#include "config/settings/choices.h"
#include "core/rng.h"
#include "scene/scene.h"
#include "tests/session/oracle.h"
#include "train/trainer.h"

namespace semfield {
namespace {

constexpr RaySourceKind kBalanced = RaySourceKind::label_balanced;

struct Fixture {
  FrameBuffer a, b;
  StoredFrame stored_a, stored_b;
  TrainingLabels::Frame labels_a;
  RayLimits limits;

  RayCamera camera{.camera = {.width_px = 8, .height_px = 4, .fx = 4, .fy = 4, .cx = 4, .cy = 2}};

  Fixture() {
    for (FrameBuffer* frame : {&a, &b}) {
      frame->width_px = 8;
      frame->height_px = 4;
      frame->rgb.assign(96, frame == &a ? 0 : 255);
      frame->label.assign(32, kVoid);
    }
    a.label[5] = 1;
    b.label[9] = 0;  // frame b's labels are not selected
  }
  RaySource make(const RaySourceOptions& options) {
    stored_a = StoredFrame(a);
    stored_b = StoredFrame(b);
    labels_a.hard = stored_a.label;
    return RaySource({{camera, &stored_a, &labels_a}, {camera, &stored_b, nullptr}}, {0, 1}, limits, options);
  }
};

TEST(RaySource, AllImagesTakesEveryPixelOfEveryFrameUniformly) {
  Fixture f;
  const RaySource source = f.make({.train = {.rays = 6400}});
  std::vector<int> hits(64);
  for (std::int64_t ray = 0; ray < 6400; ++ray) {
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
    const RaySource source = f.make({.train = {.rays = 3400, .ray_source = kind}});
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
  EXPECT_ERROR(f.make({.train = {.rays = 100, .ray_source = kBalanced}}), "labels.training.none", "label");
}

TEST(RaySource, AlphaIsThatOfThePixelAndUnknownElsewhere) {
  Fixture f;
  RaySourceOptions options{.train = {.rays = 256, .ray_source = kBalanced, .labelled_share = 0.25}};
  options.targets = {std::string(channel::alpha)};
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
  const RaySource source = f.make({.train = {.ray_source = RaySourceKind::one_image}});
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
  const RaySource source =
      f.make({.train = {.rays = 128, .ray_source = kBalanced, .labelled_share = 0.25}, .tile_rays = 32});
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

TEST(RaySource, LabelsThatMayComeAreWaitedFor) {
  Fixture f;
  f.a.label.assign(32, kVoid);
  RaySourceOptions options{.train = {.rays = 64, .label_rays_teach_color = false}};
  RaySource all = f.make(options);
  options.train.ray_source = kBalanced;
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
  RaySourceOptions options{.train = {.ray_source = kBalanced, .labelled_share = 1}, .seed = 9};
  RayCamera camera{.camera = {.width_px = 37, .height_px = 19}};
  const TrainingLabels::Frame labels[3] = {{stored[0].label, {}}, {}, {stored[2].label, {}}};
  const RaySource source(
      {{camera, &stored[0], &labels[0]}, {camera, &stored[1], nullptr}, {camera, &stored[2], &labels[2]}},
      {0, 1, kVoid}, RayLimits{}, options);
  const RandomAddress address{9, 5, stream_id("ray_source/pixel")};
  for (std::int64_t ray = 0; ray < 2000; ++ray) {
    const RaySource::Pixel got = source.choose(5, ray);
    const RaySource::Pixel want = labelled[uniform_below(address, static_cast<std::uint64_t>(ray), labelled.size())];
    ASSERT_TRUE(got.frame == want.frame && got.index == want.index) << ray;
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
  const RaySource source({{f.camera, &f.stored_a, &a}, {f.camera, &f.stored_b, &b}}, {0, kVoid, 1}, f.limits,
                         {.train = {.rays = 3000}});
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
  RaySource source = f.make({.train = {.rays = 256, .ray_source = kBalanced, .labelled_share = 1}});
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
  RaySourceOptions options{.train = {.rays = 64, .ray_source = kBalanced, .labelled_share = 1}};
  (void)f.make(options);
  f.labels_a.hard = {};
  f.labels_a.soft = SoftMap(32, 2);
  f.labels_a.soft.set_row(5, std::array<float, 2>{0.25F, 0.5F});
  RaySource source({{f.camera, &f.stored_a, &f.labels_a}, {f.camera, &f.stored_b, nullptr}}, {0, 1}, f.limits, options);
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

// What a mask hides changes no bit of a training and no score.

using namespace testing_train;

std::string masked_room(int masked, int behind, const std::string& ray_source = "auto") {
  std::string yaml = with_scene(hash_config(), "{type: analytic_room, masked: " + std::to_string(masked) +
                                                   ", behind: " + std::to_string(behind) + "}");
  return replaced(yaml, "rays: 192", "rays: 128, ray_source: " + ray_source);
}

auto scores_of(const std::string& yaml) {
  Session s = open_text(yaml);
  EvalJob job = s.eval_job(s.scene.frames_of(Split::test));
  job.fit_colors = true;
  return evaluate(*s.pipeline, job, s.limits, s.plan.class_of_logit).values();
}

TEST(Masks, WhatLiesBehindThemChangesNoBitOfATraining) {
  for (const char* source : {"all_images", "one_image", "label_balanced"}) {
    SCOPED_TRACE(source);
    const auto trained = [&](int masked, int behind) {
      return train_fingerprint(masked_room(masked, behind, source), 2, 20);
    };
    const std::uint32_t first = trained(1, -1);
    EXPECT_EQ(first, trained(1, 7));
    EXPECT_EQ(first, trained(1, 250));
    EXPECT_NE(first, trained(2, -1)) << "other pixels are masked";
    EXPECT_NE(first, trained(0, -1)) << "none is masked";
  }
}

TEST(Masks, WhatLiesBehindThemIsInNoScore) {
  const auto first = scores_of(masked_room(1, -1)), open = scores_of(masked_room(0, -1));
  EXPECT_EQ(first, scores_of(masked_room(1, 7)));
  EXPECT_EQ(first, scores_of(masked_room(1, 250)));
  ASSERT_EQ(first.size(), open.size());
  EXPECT_NE(first, open);
}

TEST(Masks, ASceneOfWhichEveryPixelIsMaskedIsRefused) {
  EXPECT_ERROR(open_text(masked_room(4, -1)), "scene.mask.all", "analytic_room", "every pixel");
}

// Named channels from a dataset to a loss: read where one wants them, cut with the batch, and said where there are
// none.

const std::string kAlbedo = "losses: [{type: albedo}]\n";

std::string albedo_config(bool offered, const std::string& more) {
  const std::string yaml = hash_config(more);
  return offered ? with_scene(yaml, "{type: analytic_room, with_albedo: true}") : yaml;
}

// Cell (y / 2, x) of the channel is that of pixel (y, x), and belongs to the ray of that pixel.
TEST(Channels, ADatasetsChannelReachesTheLossThatReadsIt) {
  const Session session = open_text(albedo_config(true, kAlbedo), channel_plugins());
  BatchBuffers batch;
  const std::unique_ptr<RaySource> rays = session.make_ray_source();
  rays->fill(3, batch);
  const std::vector<float>& albedo = batch.of("albedo");
  ASSERT_EQ(albedo.size(), batch.target.size());
  int same = 0, other = 0;
  for (std::size_t r = 0; r < batch.label.size(); ++r) {
    const std::string place = rays->place_of_row(3, static_cast<std::int64_t>(r));
    const bool even = std::stoi(place.substr(place.find("y ") + 2)) % 2 == 0;
    for (std::size_t i = 3 * r; i < 3 * r + 3; ++i) {
      EXPECT_TRUE(!even || albedo[i] == batch.target[i]) << place;
      same += even ? 1 : 0;
      other += !even && albedo[i] != batch.target[i] ? 1 : 0;
    }
  }
  EXPECT_GT(same, 100);
  EXPECT_GT(other, 10) << "odd rows show the row above";
}

TEST(Channels, WhatNoLossReadsIsNotRead) {
  const Session with = open_text(albedo_config(true, kAlbedo), channel_plugins());
  const Session without = open_text(albedo_config(true, ""), channel_plugins());
  for (std::size_t f = 0; f < with.scene.frames.size(); ++f) {
    const bool train = with.scene.info.frames[f].split == Split::train;
    EXPECT_EQ(with.scene.frames[f].channels.size(), train ? 1U : 0U);
    EXPECT_TRUE(without.scene.frames[f].channels.empty());
  }
}

TEST(RayBatch, RowsCutEveryArrayAndItsCountsOfTiles) {
  std::vector<double> three(30), two(20);
  std::vector<float> color(30), more(40);
  std::vector<std::int16_t> label(10);
  for (std::size_t r = 0; r < 10; ++r) {
    three[3 * r] = two[2 * r] = static_cast<double>(r);
    color[3 * r] = more[4 * r] = static_cast<float>(r);
    label[r] = static_cast<std::int16_t>(r);
  }
  const std::vector<std::int64_t> counts{2, 0, 1};
  RayBatch batch;
  batch.origin = batch.direction = {three.data(), 10, 3};
  batch.near_far = {two.data(), 10, 2};
  batch.targets.color = {color.data(), 10, 3};
  batch.targets.label = {label.data(), 10, 1};
  batch.targets.more.set("more", {more.data(), 10, 4});
  batch.label_only = {counts.data(), 3, 1};
  batch.tile_rays = 4;
  EXPECT_EQ(color_normaliser(batch), 21);
  const RayBatch cut = batch.rows(4, 6), part = cut.rows(4, 2), one = batch.rows(1, 1), late = batch.rows(2, 2);
  EXPECT_EQ(cut.label_only.rows, 2);
  EXPECT_EQ(cut.without_color(), 0);
  EXPECT_EQ(part.origin(0, 0), 8);
  EXPECT_EQ(part.near_far(1, 0), 9);
  EXPECT_EQ(part.targets.more["more"](0, 0), 8);
  EXPECT_EQ(part.targets.label(0, 0), 8);
  EXPECT_EQ(part.without_color(), 1);
  EXPECT_EQ(one.without_color(), 1) << "the second of two";
  EXPECT_EQ(late.without_color(), 0);
  const BatchShape shape = shape_of(batch);
  const RayBatch empty = shape.batch();
  EXPECT_EQ(shape_of(batch), shape);
  EXPECT_FALSE(shape_of(cut) == shape);
  EXPECT_EQ(empty.targets.more.begin()->name, "more");
  EXPECT_EQ(empty.targets.more.begin()->view.cols, 4);
  EXPECT_EQ(empty.origin.cols, 3);
  EXPECT_EQ(empty.targets.label.cols, 1);
}

// The number of steps that fits into a time, settled from the rate of the steps; seconds are counted, never read.

struct Course {
  double trained_s = 0;
  std::int64_t steps = 0;
  double first_settled_s = 0;
  int settled = 0;
};

/// Steps one after the other, `queued` at a time; step i takes `seconds(i, s)` after s seconds of training.
Course train(double begin_s, double until_s, int queued, const std::function<double(std::int64_t, double)>& seconds) {
  Pace pace(begin_s, until_s);
  Course course;
  std::int64_t step = 0, end = 0;
  double now_s = begin_s;
  while (end == 0 || step < end) {
    for (int i = 0; i < queued && (end == 0 || step < end); ++i) now_s += seconds(step++, now_s);
    if (const auto settled = pace.made(step, now_s, end)) {
      EXPECT_GE(*settled, step);
      end = *settled;
      if (course.settled++ == 0) course.first_settled_s = now_s - begin_s;
    }
  }
  course.trained_s = now_s - begin_s;
  course.steps = step;
  return course;
}

TEST(Pace, EqualStepsAreSettledOnceAfterATenthOfTheTime) {
  const Course course = train(0, 20, 1, [](std::int64_t, double) { return 0.05; });
  EXPECT_EQ(course.settled, 1);
  EXPECT_NEAR(course.first_settled_s, 2, 0.6);
  EXPECT_NEAR(course.trained_s, 20, 0.1);
  EXPECT_EQ(course.steps, 400);
}

TEST(Pace, ALegThatBeginsLaterHasItsOwnTime) {
  const Course course = train(100, 110, 1, [](std::int64_t, double) { return 0.02; });
  EXPECT_NEAR(course.first_settled_s, 1, 0.3);
  EXPECT_NEAR(course.trained_s, 10, 0.1);
}

struct Machine {
  const char* name;
  double time_s;
  int queued, most_settled;
  std::function<double(std::int64_t, double)> seconds;
};

void PrintTo(const Machine& machine, std::ostream* out) { *out << machine.name; }

class PaceOn : public ::testing::TestWithParam<Machine> {};

TEST_P(PaceOn, TheTimeIsMetWithinATenth) {
  const Machine& machine = GetParam();
  const Course course = train(0, machine.time_s, machine.queued, machine.seconds);
  EXPECT_NEAR(course.trained_s, machine.time_s, 0.1 * machine.time_s) << course.settled << " times settled";
  EXPECT_LE(course.first_settled_s, 0.3 * machine.time_s);
  EXPECT_LE(course.settled, machine.most_settled);
}

double noise(std::int64_t step) { return 0.5 + 0.5 * std::sin(static_cast<double>(step * step % 1009)); }

const Machine kMachines[] = {
    // Space empties: a step takes a third of its time in the end.
    {"two_cores", 20, 1, 6,
     [](std::int64_t i, double) { return 0.02 + 0.04 * std::exp(-static_cast<double>(i) / 300); }},
    {"two_cores_for_long", 300, 1, 5,
     [](std::int64_t i, double) { return 0.02 + 0.04 * std::exp(-static_cast<double>(i) / 300); }},
    {"loaded_cores", 20, 1, 2, [](std::int64_t i, double) { return 0.03 + 0.06 * noise(i); }},
    {"load_that_ends", 300, 1, 4, [](std::int64_t, double s) { return s < 120 ? 0.06 : 0.02; }},
    {"load_that_comes", 300, 1, 4, [](std::int64_t, double s) { return s < 120 ? 0.02 : 0.06; }},
    {"load_that_comes_and_goes", 300, 1, 8, [](std::int64_t, double s) { return std::fmod(s, 50) < 25 ? 0.02 : 0.05; }},
    {"gpu", 20, 32, 2, [](std::int64_t i, double) { return i < 4 ? 0.4 : 2.4e-4 + 2e-4 * noise(i); }},
    // It passes, and moves nothing.
    {"a_stall", 20, 1, 1, [](std::int64_t i, double) { return i == 200 ? 0.35 : 0.05; }},
    {"a_stall_that_cuts_it_short", 20, 1, 8, [](std::int64_t, double s) { return s > 3 && s < 13 ? 1 : 0.028; }},
    {"slow_first_step", 10, 1, 2, [](std::int64_t i, double) { return i == 0 ? 2.0 : 0.01; }},
};
INSTANTIATE_TEST_SUITE_P(Machines, PaceOn, ::testing::ValuesIn(kMachines),
                         [](const ::testing::TestParamInfo<Machine>& row) { return row.param.name; });

TEST(Pace, StepsThatTakeMostOfTheTimeEndNearIt) {
  EXPECT_EQ(train(0, 10, 1, [](std::int64_t, double) { return 4.0; }).steps, 3) << "8 s, and 2 s are half a step";
  EXPECT_EQ(train(0, 10, 1, [](std::int64_t, double) { return 60.0; }).steps, 1);
}

TEST(Pace, TheRateIsThatOfTheLastTenth) {
  Pace pace(0, 100);
  EXPECT_EQ(pace.steps_per_s(), 0);
  std::int64_t step = 0;
  double now_s = 0;
  while (now_s < 30) {
    now_s += now_s < 12 ? 1 : 0.25;
    (void)pace.made(++step, now_s, 1000);
  }
  EXPECT_NEAR(pace.steps_per_s(), 4, 1e-9);
}

}  // namespace
}  // namespace semfield
