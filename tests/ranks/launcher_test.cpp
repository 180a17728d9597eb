// What launchers say of a process, as each of them writes it into the environment.
#include "ranks/launcher.h"

#include <gtest/gtest.h>

#include <cstdlib>
#include <map>
#include <set>
#include <string>

#include "core/error.h"

namespace semfield {
namespace {

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
    EXPECT_NE(message.find(text), std::string::npos) << "'" << message << "' lacks '" << text << "'";
  };
  names(with(kOpenMpi, {{"OMPI_COMM_WORLD_SIZE", "0"}}), "OMPI_COMM_WORLD_SIZE: '0' is no number of processes");
  names(with(kOpenMpi, {{"OMPI_COMM_WORLD_SIZE", "8x"}}), "OMPI_COMM_WORLD_SIZE: '8x'");
  names(with(kOpenMpi, {{"OMPI_COMM_WORLD_SIZE", "99999999999"}}), "OMPI_COMM_WORLD_SIZE: '99999999999'");
  names(with(kOpenMpi, {{"OMPI_COMM_WORLD_RANK", "8"}}), "OMPI_COMM_WORLD_RANK: '8' is no rank of 8 processes");
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
