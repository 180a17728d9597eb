// Ranks that are threads, which tests of several ranks rely on, and ranks as launchers name them.
#include "tests/ranks/thread_ranks.h"

#include <cstdlib>
#include <set>

#include "core/error.h"
#include "execution/ranks/ranks.h"
#include "tests/says.h"

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

}  // namespace
}  // namespace semfield
