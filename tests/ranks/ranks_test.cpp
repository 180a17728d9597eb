// Ranks that are threads, which tests of several ranks rely on, and ranks as launchers name them.

#include "execution/ranks/ranks.h"

#include <cstdlib>
#include <set>

#include "compute/parallel.h"
#include "core/error.h"
#include "execution/lane_executor.h"
#include "session/session.h"
#include "session/trainer.h"
#include "tests/ranks/thread_ranks.h"
#include "tests/says.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using testing::as_ranks;

std::vector<std::byte> bytes_of(const std::string& text) {
  const auto all = std::as_bytes(std::span(text));
  return {all.begin(), all.end()};
}
std::string text_of(std::span<const std::byte> bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

TEST(ThreadRanks, EveryCallBringsWhatItSays) {
  as_ranks(3, [](Ranks& ranks) {
    ASSERT_EQ(ranks.size(), 3);
    const std::string mine(static_cast<std::size_t>(ranks.rank()), static_cast<char>('a' + ranks.rank()));
    EXPECT_EQ(texts_of(ranks, mine), (std::vector<std::string>{"", "b", "cc"}));
    std::vector<std::byte> data = bytes_of(ranks.rank() == 2 ? "xyz" : "...");
    ranks.broadcast(data, 2);
    EXPECT_EQ(text_of(data), "xyz");
    std::vector<std::byte> all(3);
    const std::size_t sizes[] = {0, 1, 2};
    ranks.gather(bytes_of(mine), all, sizes);
    EXPECT_EQ(text_of(all), ranks.rank() == 0 ? "bcc" : std::string(3, '\0'));
    std::vector<std::byte> letter(2);
    if (ranks.rank() == 0) {
      ranks.send(1, bytes_of("ab"));
      ranks.send(1, bytes_of("cd"));
    } else if (ranks.rank() == 1) {
      ranks.receive(0, letter);
      EXPECT_EQ(text_of(letter), "ab");
      ranks.receive(0, letter);
      EXPECT_EQ(text_of(letter), "cd");
    }
  });
}

TEST(ThreadRanks, AnErrorOfOneReachesAllThatAgree) {
  int thrown = 0;
  std::mutex mutex;
  as_ranks(3, [&](Ranks& ranks) {
    try {
      agree(ranks, [&] {
        if (ranks.rank() == 1) throw Error(ErrorKind::data, "test.error.made", "no room", "make some");
      });
    } catch (const Error& error) {
      const std::lock_guard lock(mutex);
      thrown += error.kind() == ErrorKind::data && error.message() == "no room" && error.remedy() == "make some";
    }
  });
  EXPECT_EQ(thrown, 3);
}

TEST(ThreadRanks, NobodyWaitsForARankThatHasEnded) {
  try {
    as_ranks(3, [](Ranks& ranks) {
      if (ranks.rank() == 1) throw Error(ErrorKind::failure, "test.error.made", "the first error", "");
      (void)all_of(ranks, 1);
    });
    FAIL() << "the others went on";
  } catch (const RankLost&) {
    FAIL() << "the error itself is what counts";
  } catch (const Error& error) {
    EXPECT_EQ(error.message(), "the first error");
  }
  EXPECT_THROW(as_ranks(2,
                        [](Ranks& ranks) {
                          if (ranks.rank() == 1) (void)all_of(ranks, 1);
                        }),
               RankLost);
}

TEST(ThreadRanks, WhoWatchesSeesThatARankHasEnded) {
  as_ranks(2, [](Ranks& ranks) {
    ranks.watch();
    (void)all_of(ranks, 1);
    if (ranks.rank() == 1) return;
    EXPECT_FALSE(ranks.lost());
    const auto watch = [&] {
      for (;;) ranks.watch();
    };
    EXPECT_THROW(watch(), RankLost);
    EXPECT_TRUE(ranks.lost());
  });
}

// What launchers say of a process, as each of them writes it into the environment.

using Variables = std::map<std::string, std::string>;

std::optional<Launched> launched_in(const Variables& variables) {
  return launched([&](const char* name) {
    const auto found = variables.find(name);
    return found == variables.end() ? nullptr : found->second.c_str();
  });
}

void expect_place(const Variables& variables, const Launched& expected) {
  const std::optional<Launched> found = launched_in(variables);
  ASSERT_TRUE(found.has_value());
  EXPECT_EQ(found->rank, expected.rank);
  EXPECT_EQ(found->size, expected.size);
  EXPECT_EQ(found->local_rank, expected.local_rank);
  EXPECT_EQ(found->local_size, expected.local_size);
  EXPECT_EQ(found->by, expected.by);
}

// The message of the error; "" where there is none.
std::string refusal(const Variables& variables) {
  try {
    launched_in(variables);
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::config);
    EXPECT_NE(error.remedy(), "");
    return error.message();
  }
  return "";
}

const Variables kOpenMpi{{"OMPI_COMM_WORLD_RANK", "5"},
                         {"OMPI_COMM_WORLD_SIZE", "8"},
                         {"OMPI_COMM_WORLD_LOCAL_RANK", "1"},
                         {"OMPI_COMM_WORLD_LOCAL_SIZE", "4"}};
const Variables kStep{{"SLURM_STEP_NUM_TASKS", "7"}, {"SLURM_PROCID", "5"}, {"SLURM_LOCALID", "1"}};

Variables with(Variables variables, const Variables& more) {
  for (const auto& [name, value] : more) variables[name] = value;
  return variables;
}

TEST(Launcher, AProcessStartedByHandIsNoRank) {
  EXPECT_FALSE(launched_in({}).has_value());
  EXPECT_FALSE(launched_in({{"PMIX_RANK", "1"}}).has_value());
  EXPECT_FALSE(launched_in({{"OMPI_COMM_WORLD_RANK", ""}, {"OMPI_COMM_WORLD_SIZE", ""}}).has_value());
}

TEST(Launcher, AloneUnderALauncherIsNoRankEither) {
  EXPECT_FALSE(launched_in({{"OMPI_COMM_WORLD_RANK", "0"},
                            {"OMPI_COMM_WORLD_SIZE", "1"},
                            {"OMPI_COMM_WORLD_LOCAL_RANK", "0"},
                            {"OMPI_COMM_WORLD_LOCAL_SIZE", "1"}})
                   .has_value());
  EXPECT_FALSE(launched_in({{"PMI_RANK", "0"}, {"PMI_SIZE", "1"}}).has_value());
  EXPECT_FALSE(launched_in({{"SLURM_STEP_NUM_TASKS", "1"}, {"SLURM_PROCID", "0"}}).has_value());
}

TEST(Launcher, OpenMpi) {
  expect_place(kOpenMpi, {5, 8, 1, 4, "mpirun"});
  // Its helpers may have been started by srun, as a step of their own.
  expect_place(with(kOpenMpi, {{"SLURM_STEP_NUM_TASKS", "2"}, {"SLURM_PROCID", "1"}}), {5, 8, 1, 4, "mpirun"});
}

TEST(Launcher, LaunchersThatSpeakPmi) {
  expect_place({{"PMI_RANK", "2"}, {"PMI_SIZE", "4"}}, {2, 4, 2, 4, "mpirun"});
  const Variables local{{"PMI_RANK", "2"}, {"PMI_SIZE", "4"}, {"MPI_LOCALRANKID", "0"}, {"MPI_LOCALNRANKS", "2"}};
  expect_place(local, {2, 4, 0, 2, "mpirun"});
  expect_place(with(local, {{"SLURM_STEP_NUM_TASKS", "2"}, {"SLURM_PROCID", "1"}}), {2, 4, 0, 2, "mpirun"});
}

TEST(Launcher, AStepOfSlurm) {
  expect_place(with(kStep, {{"SLURM_NODEID", "2"}, {"SLURM_STEP_TASKS_PER_NODE", "2(x2),3"}}), {5, 7, 1, 3, "srun"});
  expect_place(with(kStep, {{"SLURM_NODEID", "1"}, {"SLURM_STEP_TASKS_PER_NODE", "2(x2),3"}}), {5, 7, 1, 2, "srun"});
  expect_place(kStep, {5, 7, 1, 7, "srun"});
  expect_place({{"SLURM_STEP_NUM_TASKS", "7"}, {"SLURM_PROCID", "5"}}, {5, 7, 5, 7, "srun"});
  // Speaking PMI.
  expect_place(with(kStep, {{"PMI_RANK", "5"}, {"PMI_SIZE", "7"}}), {5, 7, 1, 7, "srun"});
}

// It is given the rank of its one task, and the size of the whole job.
TEST(Launcher, ABatchScriptIsNoStep) {
  EXPECT_FALSE(launched_in({{"SLURM_PROCID", "0"},
                            {"SLURM_LOCALID", "0"},
                            {"SLURM_NODEID", "0"},
                            {"SLURM_NTASKS", "8"},
                            {"SLURM_TASKS_PER_NODE", "4(x2)"}})
                   .has_value());
}

TEST(Launcher, NumbersWithoutSenseAreRefusedByTheirVariable) {
  const auto names = [](const Variables& variables, const std::string& text) {
    const std::string message = refusal(variables);
    EXPECT_HAS(message, text) << "'" << message << "' lacks '" << text << "'";
  };
  names(with(kOpenMpi, {{"OMPI_COMM_WORLD_SIZE", "0"}}), "OMPI_COMM_WORLD_SIZE: '0' is not a number of processes");
  names(with(kOpenMpi, {{"OMPI_COMM_WORLD_SIZE", "8x"}}), "OMPI_COMM_WORLD_SIZE: '8x'");
  names(with(kOpenMpi, {{"OMPI_COMM_WORLD_SIZE", "99999999999"}}), "OMPI_COMM_WORLD_SIZE: '99999999999'");
  names(with(kOpenMpi, {{"OMPI_COMM_WORLD_RANK", "8"}}), "OMPI_COMM_WORLD_RANK: '8' is not a rank of 8 processes");
  names(with(kOpenMpi, {{"OMPI_COMM_WORLD_RANK", "-1"}}), "OMPI_COMM_WORLD_RANK: '-1'");
  names(with(kOpenMpi, {{"OMPI_COMM_WORLD_RANK", ""}}), "OMPI_COMM_WORLD_RANK is not set");
  names(with(kOpenMpi, {{"OMPI_COMM_WORLD_LOCAL_RANK", "4"}}), "OMPI_COMM_WORLD_LOCAL_RANK: '4'");
  names({{"PMI_RANK", "1"}}, "PMI_SIZE is not set");
  names({{"PMI_RANK", "4"}, {"PMI_SIZE", "4"}}, "PMI_RANK: '4'");
  names({{"PMI_RANK", "1"}, {"PMI_SIZE", "4"}, {"MPI_LOCALRANKID", "2"}, {"MPI_LOCALNRANKS", "2"}},
        "MPI_LOCALRANKID: '2'");
  names(with(kStep, {{"SLURM_STEP_NUM_TASKS", "0"}}), "SLURM_STEP_NUM_TASKS: '0'");
  names(with(kStep, {{"SLURM_PROCID", "7"}}), "SLURM_PROCID: '7'");
  names(with(kStep, {{"SLURM_LOCALID", "7"}}), "SLURM_LOCALID: '7'");
  names(with(kStep, {{"SLURM_NODEID", "2"}, {"SLURM_STEP_TASKS_PER_NODE", "4(x2)"}}),
        "SLURM_STEP_TASKS_PER_NODE: '4(x2)' does not tell the tasks of node 2");
  names(with(kStep, {{"SLURM_STEP_TASKS_PER_NODE", "four"}}), "SLURM_STEP_TASKS_PER_NODE: 'four'");
}

std::set<std::string> settings_of_child() {
  std::set<std::string> settings;
  for (const char* entry : environment_of_child())
    if (entry != nullptr) settings.insert(entry);
  return settings;
}

TEST(Launcher, AChildIsNoRankAndKeepsTheRest) {
  setenv("OMPI_MCA_plm_rsh_agent", "sh", 1);
  setenv("OMPI_ALLOW_RUN_AS_ROOT", "1", 1);
  setenv("SLURM_JOB_ID", "12", 1);
  // By hand: what a user sets for launchers reaches one that this process starts.
  EXPECT_TRUE(settings_of_child().contains("OMPI_MCA_plm_rsh_agent=sh"));
  for (const auto& [name, value] : with(kOpenMpi, kStep)) setenv(name.c_str(), value.c_str(), 1);
  setenv("PMIX_NAMESPACE", "4711", 1);
  ASSERT_TRUE(launched().has_value());
  const std::set<std::string> kept = settings_of_child();
  for (const auto& [name, value] : with(kOpenMpi, kStep)) EXPECT_FALSE(kept.contains(name + "=" + value)) << name;
  EXPECT_FALSE(kept.contains("PMIX_NAMESPACE=4711"));
  EXPECT_FALSE(kept.contains("OMPI_MCA_plm_rsh_agent=sh"));
  EXPECT_TRUE(kept.contains("OMPI_ALLOW_RUN_AS_ROOT=1"));
  EXPECT_TRUE(kept.contains("SLURM_JOB_ID=12"));
}

// Sessions whose work several processes share: the same bits, the same pictures and the same errors as in one. The
// processes are threads here.

using namespace testing_train;

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
  EXPECT_HAS(message, "this test");
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
