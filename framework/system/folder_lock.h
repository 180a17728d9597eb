// A hold on a folder or a file, alone or shared, that ends with the processes that have it, however they end.
#pragma once

#include <sys/types.h>

#include <string>

namespace semfield {

/// flock of `FOLDER/.lock`, which says who took it last. The lock file stays: removing it would let two processes lock
/// two files of one name.
class FolderLock {
 public:
  FolderLock() = default;
  FolderLock(FolderLock&& other) noexcept;
  FolderLock& operator=(FolderLock&& other) noexcept;
  ~FolderLock();

  /// 0: held from now on. EWOULDBLOCK: another has it, whom holder() names. ENOENT: no lock file is there, and none may
  /// be created. Any other errno: the folder cannot be written.
  int take(const std::string& folder, bool may_create = true);
  /// The same for one file in a folder that others may use: flock of `.NAME.lock` beside it, under any path that leads
  /// to the file.
  int take_file(const std::string& file);
  /// As take() for a hold that others may share, while nobody has the folder alone; then EWOULDBLOCK.
  int share(const std::string& folder);
  bool held() const { return descriptor_ >= 0; }
  /// Of a call that found another: "process 4711 on HOST", as far as the lock file tells.
  const std::string& holder() const { return holder_; }
  /// Writes the process for which it is held into the file. Errno or 0.
  int sign(pid_t process) const;
  /// In a forked child: the lock lives until the program that it starts has ended too. Async-signal-safe.
  void keep_over_exec() const;

 private:
  int lock(const std::string& lock_file, int how, int more_flags);
  void release();
  int descriptor_ = -1;
  std::string holder_;
};

}  // namespace semfield
