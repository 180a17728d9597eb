// Named channels from a dataset to a loss: read where one wants them, cut with the batch, and said where there are
// none.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "session/ray_source.h"
#include "session/trainer.h"
#include "tests/session/oracle.h"

namespace semfield {
namespace {

using namespace testing_train;

const std::string kAlbedo = "losses: [{type: albedo}]\n";

std::string albedo_config(bool offered, const std::string& more) {
  std::string yaml = hash_config(more);
  const std::string scene = "{type: analytic_room";
  return offered ? yaml.replace(yaml.find(scene), scene.size(), scene + ", with_albedo: true") : yaml;
}

// Cell (y / 2, x) of the channel is that of pixel (y, x), and belongs to the ray of that pixel.
TEST(Channels, ADatasetsChannelReachesTheLossThatReadsIt) {
  Registry registry = make_channel_registry();
  const Session session = open_text(albedo_config(true, kAlbedo), registry);
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
  Registry registry = make_channel_registry();
  const Session with = open_text(albedo_config(true, kAlbedo), registry);
  const Session without = open_text(albedo_config(true, ""), registry);
  for (std::size_t f = 0; f < with.scene.frames.size(); ++f) {
    const bool train = with.scene.info.frames[f].split == Split::train;
    EXPECT_EQ(with.scene.frames[f].channels.size(), train ? 1U : 0U);
    EXPECT_TRUE(without.scene.frames[f].channels.empty());
  }
}

TEST(Channels, ALossWithoutItsChannelIsLeftOutAndSaysSo) {
  Registry registry = make_channel_registry();
  const Session session = open_text(albedo_config(false, kAlbedo), registry);
  EXPECT_TRUE(session.config.losses.empty());
  const auto& rows = session.plan.left_out;
  const auto row =
      std::find_if(rows.begin(), rows.end(), [](const LeftOut& r) { return r.component == "loss_albedo"; });
  ASSERT_NE(row, rows.end());
  EXPECT_EQ(row->evidence, "no training frame has 'albedo'");
}

// A second error of all rays against nearly the same colours: gradients of twice that and more.
TEST(Channels, ALossOnAChannelTrains) {
  Registry registry = make_channel_registry();
  Session session = open_text(albedo_config(true, kAlbedo), registry);
  const std::unique_ptr<RaySource> rays = session.make_ray_source();
  Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule, session.config.train.steps);
  const double first = trainer.advance().terms[0];
  double last = first;
  while (trainer.step() < 60) last = trainer.advance().terms[0];
  EXPECT_GT(first, 0);
  EXPECT_LT(last, 0.5 * first);
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

}  // namespace
}  // namespace semfield
