// Sessions whose work several processes share: the same bits, the same pictures and the same errors as in one. The
// processes are threads here.
#include "compute/parallel.h"
#include "execution/lane_executor.h"
#include "session/session.h"
#include "session/trainer.h"
#include "tests/ranks/thread_ranks.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;
using testing::as_ranks;

/// `body` gets the session of rank 0; the other ranks follow.
void as_leader(int size, const std::string& yaml, const std::function<void(Session&)>& body) {
  as_ranks(size, [&](Ranks& ranks) {
    Registry registry = make_channel_registry();
    if (ranks.rank() != 0) return follow(ranks, registry);
    {
      Session session = open_text(yaml, registry, {}, &ranks);
      body(session);
    }
    dismiss(ranks);
  });
}

void train(Session& session, std::int64_t steps) {
  const auto rays = session.make_ray_source();
  Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule, session.config.train.steps);
  while (trainer.step() < steps) trainer.advance();
  trainer.collect();
}

std::uint32_t fingerprint_of_ranks(int size, const std::string& yaml, std::int64_t steps) {
  std::uint32_t found = 0;
  as_leader(size, yaml, [&](Session& session) {
    train(session, steps);
    found = fingerprint(session.pipeline->store());
  });
  return found;
}

std::string two_tables_config() {
  std::string yaml = two_pass_config();
  for (std::size_t at = 0; (at = yaml.find("position: {type: frequency, frequencies: 3}", at)) != std::string::npos;)
    yaml.replace(at, 43, "position: {type: hash_grid, levels: 3, log2_entries: 8, finest_resolution: 32}");
  return yaml;
}

struct Shape {
  const char* name;
  std::string yaml;
  std::int64_t steps;
};

// Past the warm-up of the occupancy grid; two passes; tables of two passes; bf16; fewer lanes than ranks.
TEST(RanksSession, TrainingHasTheBitsOfOneProcess) {
  std::string labels_apart = hash_config(), albedo = hash_config("losses: [{type: albedo}]\n");
  labels_apart.replace(labels_apart.find("train: {"), 8,
                       "train: {ray_source: label_balanced, labelled_share: 0.3, label_rays_teach_color: false, ");
  albedo.replace(albedo.find("{type: analytic_room"), 20, "{type: analytic_room, with_albedo: true");
  std::string head = hash_config(
      "heads:\n  - {type: feature_map, channel: albedo, width: 2, branch: {position: {type: frequency, frequencies: "
      "2}, "
      "field: {type: tiny_mlp, hidden_width: 8, hidden_layers: 1}}}\n"
      "losses: [{type: cosine_distance, channel: albedo}]\n");
  head.replace(head.find("{type: analytic_room"), 20, "{type: analytic_room, with_albedo: true");
  const Shape shapes[] = {
      {"a head on principal axes", head, 12},
      {"hash grid", hash_config(), 60},
      {"two passes", two_pass_config(), 6},
      {"two tables", two_tables_config(), 6},
      {"bf16", hash_config("runtime: {precision: bf16}\n"), 20},
      {"two lanes", hash_config("runtime: {lanes: 2}\n"), 20},
      {"labels apart", labels_apart, 12},
      {"a channel of the dataset", albedo, 12},
      {"a term from step 8 on", hash_config("losses: [{type: distortion, from_step: 0.04}]\n"), 12}};
  for (const Shape& shape : shapes) {
    SCOPED_TRACE(shape.name);
    const std::uint32_t alone = train_fingerprint(shape.yaml, 1, shape.steps);
    for (const int size : {1, 2, 3, 5}) EXPECT_EQ(fingerprint_of_ranks(size, shape.yaml, shape.steps), alone) << size;
  }
}

TEST(RanksSession, LossesAreThoseOfOneProcess) {
  const auto losses_of = [](Session& session) {
    const auto rays = session.make_ray_source();
    Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule);
    return trainer.advance();
  };
  Session alone = open_text(two_pass_config());
  const StepLosses expected = losses_of(alone);
  as_leader(3, two_pass_config(), [&](Session& session) {
    const StepLosses found = losses_of(session);
    EXPECT_EQ(found.total, expected.total);
    EXPECT_EQ(found.semantic, expected.semantic);
    EXPECT_EQ(found.samples, expected.samples);
    EXPECT_EQ(found.labelled, expected.labelled);
    EXPECT_EQ(found.correct, expected.correct);
  });
}

template <class T>
void expect_same(const std::vector<T>& found, const std::vector<T>& expected, const char* what) {
  ASSERT_EQ(found.size(), expected.size()) << what;
  ASSERT_FALSE(found.empty()) << what;
  EXPECT_EQ(std::memcmp(found.data(), expected.data(), found.size() * sizeof(T)), 0) << what;
}

TEST(RanksSession, FramesAndScoresAreThoseOfOneProcess) {
  const auto frame_of = [](const Session& s) {
    const FrameInfo& info = s.scene.info.frames.front();
    FrameOptions options;
    options.classes = s.classes();
    options.probability = true;
    return render_frame(*s.pipeline, {info.camera, info.world_from_camera, false}, s.limits, s.plan.class_of_logit, {},
                        options);
  };
  const auto score_of = [](const Session& s) {
    return evaluate(*s.pipeline, s.eval_job(s.scene.frames_of(Split::test)), s.limits, s.plan.class_of_logit).values();
  };
  Session alone = open_text(hash_config());
  train(alone, 40);
  const RenderedFrame expected = frame_of(alone);
  const auto scores = score_of(alone);
  for (const int size : {2, 3}) {
    as_leader(size, hash_config(), [&](Session& session) {
      train(session, 40);
      const RenderedFrame found = frame_of(session);
      expect_same(found.rgb, expected.rgb, "rgb");
      expect_same(found.depth_m, expected.depth_m, "depth");
      expect_same(found.label, expected.label, "label");
      expect_same(found.entropy, expected.entropy, "entropy");
      expect_same(found.probability, expected.probability, "probability");
      EXPECT_EQ(score_of(session), scores);
    });
  }
}

TEST(RanksSession, DensitiesAreThoseOfOneProcess) {
  std::vector<double> positions;
  for (int i = 0; i < 1000; ++i) positions.insert(positions.end(), {0.001 * i, 0.4, 0.5 - 0.0007 * i});
  const auto densities_of = [&](const Session& s) {
    std::vector<float> sigma(positions.size() / 3);
    s.pipeline->density({positions.data(), std::ssize(sigma), 3}, {sigma.data(), std::ssize(sigma), 1});
    return sigma;
  };
  const std::vector<float> expected = densities_of(open_text(hash_config()));
  as_leader(3, hash_config(), [&](Session& session) { expect_same(densities_of(session), expected, "density"); });
}

// Message of a step with a weight that is not a number, and the tensors after the weight was mended and steps went on.
struct Mended {
  std::string message;
  std::uint32_t after = 0;
};
Mended break_and_mend(Session& session) {
  Mended out;
  const auto rays = session.make_ray_source();
  Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule);
  for (int i = 0; i < 3; ++i) trainer.advance();
  trainer.collect();
  float& weight = session.pipeline->store().find("fine/field/trunk_1/weight")->value.data()[5];
  const float sound = weight;
  weight = std::numeric_limits<float>::quiet_NaN();
  session.pipeline->executor().upload(trainer.step());
  out.message = error_of([&] { trainer.advance(); });
  weight = sound;
  session.pipeline->executor().upload(trainer.step());
  for (int i = 0; i < 3; ++i) trainer.advance();
  trainer.collect();
  out.after = fingerprint(session.pipeline->store());
  return out;
}

TEST(RanksSession, AStepThatFailsSaysWhatItSaysInOneProcessAndChangesNothing) {
  set_thread_count(
      1);  // with more it is chance which ray ends the step, and the first ray's error is reported beside it
  Session alone = open_text(two_pass_config());
  const Mended expected = break_and_mend(alone);
  ASSERT_NE(expected.message.find("fine/field/trunk_1/weight"), std::string::npos) << expected.message;
  as_leader(3, two_pass_config(), [&](Session& session) {
    const Mended found = break_and_mend(session);
    EXPECT_EQ(found.message, expected.message);
    EXPECT_EQ(found.after, expected.after);
  });
  set_thread_count(0);
}

TEST(RanksSession, RaysThatCannotBeRenderedAreAnErrorOfAllAndTheNextFrameIsSound) {
  as_leader(3, hash_config(), [&](Session& session) {
    std::vector<double> origin(90, 0.5), direction(90, 0.0), near_far(60, 0.1);
    for (std::size_t r = 0; r < 30; ++r) {
      direction[3 * r] = 1;
      near_far[2 * r + 1] = 1;
    }
    std::vector<float> color(90);
    RenderJob<float> job{.origin = {origin.data(), 30, 3},
                         .direction = {direction.data(), 30, 3},
                         .near_far = {near_far.data(), 30, 2},
                         .color = {color.data(), 30, 3}};
    direction[3 * 25] = std::numeric_limits<double>::quiet_NaN();  // the last rank's
    EXPECT_THROW(session.pipeline->render(job), Error);
    direction[3 * 25] = 1;
    session.pipeline->render(job);
    EXPECT_EQ(color[0], color[3 * 29]);
  });
}

// Rank 1 reads a wrong number out of one message: what its memory, or a machine of another kind, might do.
class Tampered final : public Ranks {
 public:
  explicit Tampered(Ranks& inner) : inner_(inner) {}
  int rank() const override { return inner_.rank(); }
  int size() const override { return inner_.size(); }
  const std::string& name_of(int rank) const override { return inner_.name_of(rank); }
  int local_rank() const override { return inner_.local_rank(); }
  int local_size() const override { return inner_.local_size(); }
  void broadcast(std::span<std::byte> data, int root) override {
    inner_.broadcast(data, root);
    if (rank() != 1 || root != 2 || data.size() < 4096) return;  // gradients: rank 2 has the last lanes of three ranks
    const float wrong = 1e-3F;
    std::memcpy(data.data(), &wrong, sizeof wrong);
  }
  void all_gather(std::span<const std::byte> mine, std::span<std::byte> all,
                  std::span<const std::size_t> bytes) override {
    inner_.all_gather(mine, all, bytes);
  }
  void gather(std::span<const std::byte> mine, std::span<std::byte> all, std::span<const std::size_t> bytes) override {
    inner_.gather(mine, all, bytes);
  }
  void send(int to, std::span<const std::byte> data) override { inner_.send(to, data); }
  void receive(int from, std::span<std::byte> data) override { inner_.receive(from, data); }
  void end_when(std::function<bool()> asked, std::function<void()> hear) override {
    inner_.end_when(std::move(asked), std::move(hear));
  }
  void watch() override { inner_.watch(); }
  bool lost() const override { return inner_.lost(); }
  void abandon(int code) override { inner_.abandon(code); }

 private:
  Ranks& inner_;
};

TEST(RanksSession, TensorsThatDriftApartAreNoCheckpoint) {
  std::string message;
  as_ranks(3, [&](Ranks& inner) {
    Tampered ranks(inner);
    Registry registry = make_channel_registry();
    if (ranks.rank() != 0) return follow(ranks, registry);
    {
      Session session = open_text(two_pass_config(), registry, {}, &ranks);
      message = error_of([&] { train(session, 2); });
    }
    dismiss(ranks);
  });
  EXPECT_EQ(message,
            "the tensors of rank 1 of this test are no longer those of rank 0 of this test; resume from the last "
            "checkpoint; if it happens again, a machine computes wrongly, or is of another kind");
}

// Tile t belongs to lane t mod lanes, so the first lanes may have a tile more than the others.
TEST(LaneRanks, RangesOfLanesCoverAllAndHaveEquallyManyTilesAsFarAsLanesAllow) {
  const struct {
    int lanes, size;
    std::int64_t tiles, most;  // of a rank
  } rows[] = {{48, 2, 64, 32}, {48, 16, 64, 4}, {48, 3, 64, 22}, {8, 2, 8, 4},
              {8, 3, 6, 2},    {2, 3, 9, 5},    {48, 2, 3, 2},   {48, 5, 1, 1}};
  for (const auto& row : rows) {
    std::vector<int> first(static_cast<std::size_t>(row.size) + 1);
    as_ranks(row.size, [&](Ranks& ranks) {
      LaneRanks<float> shares(ranks, row.lanes);
      shares.share_out(row.tiles);
      first[ranks.rank()] = shares.first();
      if (ranks.rank() + 1 == ranks.size()) first.back() = shares.end();
    });
    EXPECT_EQ(first.front(), 0);
    EXPECT_EQ(first.back(), row.lanes);
    std::int64_t most = 0;
    for (std::size_t r = 0; r + 1 < first.size(); ++r) {
      ASSERT_LE(first[r], first[r + 1]);
      std::int64_t tiles = 0;
      for (std::int64_t tile = 0; tile < row.tiles; ++tile)
        tiles += tile % row.lanes >= first[r] && tile % row.lanes < first[r + 1] ? 1 : 0;
      most = std::max(most, tiles);
    }
    EXPECT_EQ(most, row.most) << row.tiles << " tiles in " << row.lanes << " lanes on " << row.size << " ranks";
  }
}

TEST(RanksSession, TellsItsProcessesAndRefusesAHook) {
  as_leader(2, two_pass_config(), [&](Session& session) {
    Executor<float>& executor = session.pipeline->executor();
    EXPECT_EQ(executor.description(), "cpu, 2 processes on 1 host");
    executor.set_gradient_hook(nullptr);
    EXPECT_THROW(executor.set_gradient_hook([](const StepGradients<float>&) {}), Error);
  });
}

TEST(RanksSession, ARankThatEndsIsMetByRank0) {
  EXPECT_THROW(as_ranks(3,
                        [&](Ranks& ranks) {
                          Registry registry = make_registry();
                          if (ranks.rank() == 2) return;
                          if (ranks.rank() == 1) return follow(ranks, registry);
                          Session session = open_text(two_pass_config(), registry, {}, &ranks);
                          train(session, 2);
                        }),
               RankLost);
}

}  // namespace
}  // namespace semfield
