// Ranks that are threads, which tests of several ranks rely on, and ranks as launchers name them.

#include <cstdlib>
#include <set>

#include "compute/parallel.h"
#include "execution/lane_executor.h"
#include "tests/ranks/thread_ranks.h"
#include "tests/says.h"
#include "tests/session/step_configs.h"
#include "train/session.h"
#include "train/trainer.h"

namespace semfield {
namespace {

using testing::as_ranks;

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

// What launchers say of a process, as each of them writes it into the environment.

using Variables = std::map<std::string, std::string>;

std::optional<Launched> launched_in(const Variables& variables) {
  return launched([&](const char* name) {
    const auto found = variables.find(name);
    return found == variables.end() ? nullptr : found->second.c_str();
  });
}

std::string place_in(const Variables& variables) {
  const std::optional<Launched> found = launched_in(variables);
  if (!found) return "no rank";
  return std::to_string(found->rank) + " of " + std::to_string(found->size) + ", " + std::to_string(found->local_rank) +
         " of " + std::to_string(found->local_size) + " by " + found->by;
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

TEST(Launcher, EachNamesTheRankInItsOwnWords) {
  const Variables pmi{{"PMI_RANK", "2"}, {"PMI_SIZE", "4"}};
  const Variables local = with(pmi, {{"MPI_LOCALRANKID", "0"}, {"MPI_LOCALNRANKS", "2"}});
  const Variables step_of_two{{"SLURM_STEP_NUM_TASKS", "2"}, {"SLURM_PROCID", "1"}};
  const Variables nodes{{"SLURM_NODEID", "2"}, {"SLURM_STEP_TASKS_PER_NODE", "2(x2),3"}};
  const std::pair<Variables, const char*> rows[] = {
      // By hand, or alone under a launcher.
      {{}, "no rank"},
      {{{"PMIX_RANK", "1"}}, "no rank"},
      {{{"OMPI_COMM_WORLD_RANK", ""}, {"OMPI_COMM_WORLD_SIZE", ""}}, "no rank"},
      {{{"OMPI_COMM_WORLD_RANK", "0"},
        {"OMPI_COMM_WORLD_SIZE", "1"},
        {"OMPI_COMM_WORLD_LOCAL_RANK", "0"},
        {"OMPI_COMM_WORLD_LOCAL_SIZE", "1"}},
       "no rank"},
      {{{"PMI_RANK", "0"}, {"PMI_SIZE", "1"}}, "no rank"},
      {{{"SLURM_STEP_NUM_TASKS", "1"}, {"SLURM_PROCID", "0"}}, "no rank"},
      // Helpers of Open MPI may have been started by srun, as a step of their own.
      {kOpenMpi, "5 of 8, 1 of 4 by mpirun"},
      {with(kOpenMpi, step_of_two), "5 of 8, 1 of 4 by mpirun"},
      {pmi, "2 of 4, 2 of 4 by mpirun"},
      {local, "2 of 4, 0 of 2 by mpirun"},
      {with(local, step_of_two), "2 of 4, 0 of 2 by mpirun"},
      {with(kStep, nodes), "5 of 7, 1 of 3 by srun"},
      {with(with(kStep, nodes), {{"SLURM_NODEID", "1"}}), "5 of 7, 1 of 2 by srun"},
      {kStep, "5 of 7, 1 of 7 by srun"},
      {{{"SLURM_STEP_NUM_TASKS", "7"}, {"SLURM_PROCID", "5"}}, "5 of 7, 5 of 7 by srun"},
      {with(kStep, {{"PMI_RANK", "5"}, {"PMI_SIZE", "7"}}), "5 of 7, 1 of 7 by srun"},
      // A batch script is given the rank of its one task, and the size of the whole job.
      {{{"SLURM_PROCID", "0"},
        {"SLURM_LOCALID", "0"},
        {"SLURM_NODEID", "0"},
        {"SLURM_NTASKS", "8"},
        {"SLURM_TASKS_PER_NODE", "4(x2)"}},
       "no rank"}};
  for (const auto& [variables, place] : rows) EXPECT_EQ(place_in(variables), place);
}

TEST(Launcher, NumbersWithoutSenseAreRefusedByTheirVariable) {
  const Variables pmi{{"PMI_RANK", "1"}, {"PMI_SIZE", "4"}, {"MPI_LOCALRANKID", "1"}, {"MPI_LOCALNRANKS", "2"}};
  const std::tuple<Variables, const char*, const char*> rows[] = {{kOpenMpi, "OMPI_COMM_WORLD_SIZE", "0"},
                                                                  {kOpenMpi, "OMPI_COMM_WORLD_SIZE", "8x"},
                                                                  {kOpenMpi, "OMPI_COMM_WORLD_SIZE", "99999999999"},
                                                                  {kOpenMpi, "OMPI_COMM_WORLD_RANK", "8"},
                                                                  {kOpenMpi, "OMPI_COMM_WORLD_RANK", "-1"},
                                                                  {kOpenMpi, "OMPI_COMM_WORLD_RANK", ""},
                                                                  {kOpenMpi, "OMPI_COMM_WORLD_LOCAL_RANK", "4"},
                                                                  {pmi, "PMI_SIZE", ""},
                                                                  {pmi, "PMI_RANK", "4"},
                                                                  {pmi, "MPI_LOCALRANKID", "2"},
                                                                  {kStep, "SLURM_STEP_NUM_TASKS", "0"},
                                                                  {kStep, "SLURM_PROCID", "7"},
                                                                  {kStep, "SLURM_LOCALID", "7"},
                                                                  {kStep, "SLURM_STEP_TASKS_PER_NODE", "four"}};
  for (const auto& [variables, name, value] : rows)
    EXPECT_HAS(refusal(with(variables, {{name, value}})), name, value) << name << "=" << value;
  EXPECT_HAS(refusal(with(kStep, {{"SLURM_NODEID", "2"}, {"SLURM_STEP_TASKS_PER_NODE", "4(x2)"}})), "node 2");
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

StepLosses train(Session& session, std::int64_t steps) {
  Trainer trainer(session);
  StepLosses last;
  while (trainer.step() < steps) last = trainer.advance().back();
  trainer.collect();
  return last;
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

// Also past the warm-up of the occupancy grid, with tables of two passes, in bf16, and with fewer lanes than ranks.
TEST(RanksSession, TrainingHasTheBitsAndLossesOfOneProcess) {
  std::vector<Shape> shapes{
      {"hash grid", hash_config(), 60},
      {"two tables", two_tables_config(), 6},
      {"bf16", hash_config("runtime: {precision: bf16}\n"), 20},
      {"class weights", replaced(hash_config(), "semantics: {", "semantics: {balance_classes: true, "), 8},
      {"two lanes", hash_config("runtime: {lanes: 2}\n"), 20},
      {"a term from step 8 on", hash_config("losses: [{type: distortion, from_step: 0.04}]\n"), 12}};
  for (const StepCase& step : kStepCases) shapes.push_back({step.name, step.config(step.more), 8});
  for (const Shape& shape : shapes) {
    SCOPED_TRACE(shape.name);
    TestRun alone(shape.yaml);
    const StepLosses expected = alone.to(shape.steps);
    for (const int size : {2, 3}) {
      as_leader(size, shape.yaml, [&](Session& session) {
        const StepLosses found = train(session, shape.steps);
        EXPECT_EQ(found.total, expected.total) << size;
        EXPECT_EQ(found.samples, expected.samples) << size;
        EXPECT_EQ(fingerprint(session.pipeline->store()), alone.bits()) << size;
      });
    }
  }
}

TEST(RanksSession, DensitiesAreThoseOfOneProcess) {
  std::vector<double> positions;
  for (int i = 0; i < 1000; ++i) positions.insert(positions.end(), {0.001 * i, 0.4, 0.5 - 0.0007 * i});
  const auto densities_of = [&](const Session& s) {
    std::vector<float> sigma(positions.size() / 3);
    s.pipeline->executor().density({positions.data(), std::ssize(sigma), 3}, {sigma.data(), std::ssize(sigma), 1});
    return sigma;
  };
  const std::vector<float> expected = densities_of(open_text(hash_config()));
  ASSERT_EQ(expected.size(), 1000U);
  as_leader(3, hash_config(), [&](Session& session) { EXPECT_EQ(densities_of(session), expected); });
}

// Message of a step with a weight that is not a number, and the tensors after the weight was mended and steps went on.
struct Mended {
  std::string message;
  std::uint32_t after = 0;
};
Mended break_and_mend(Session& session) {
  Mended out;
  Trainer trainer(session);
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
    EXPECT_THROW(session.pipeline->executor().render(job), Error);
    direction[3 * 25] = 1;
    session.pipeline->executor().render(job);
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

TEST(RanksSession, TellsItsProcesses) {
  as_leader(2, two_pass_config(), [&](Session& session) {
    Executor<float>& executor = session.pipeline->executor();
    EXPECT_EQ(executor.description(), "cpu, 2 processes on 1 host");
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
