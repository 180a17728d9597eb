// Where a program keeps what it can make again, and how much of it.
#pragma once

#include <cstdint>
#include <string>

namespace semfield {

/// FOLDER/NAME of the user's cache, made if need be: the environment variable SEMFIELD_CACHE, else
/// XDG_CACHE_HOME/semfield, else HOME/.cache/semfield. "" where SEMFIELD_CACHE is `off`, where none of them is set, and
/// where the folder cannot be made: then nothing is kept.
std::string cache_folder(const std::string& name);

/// Bytes that a cache folder may hold: SEMFIELD_CACHE_GB, or 2 GB. Throws Error(config) for what is no number.
std::uint64_t cache_limit();

/// Notes that `entry`, a folder in a cache folder, is used now, and removes the entries unused for longest until the
/// folder holds at most `limit` bytes; `entry` stays. Others may read an entry meanwhile: they make anew what is gone.
void use_cache_entry(const std::string& entry, std::uint64_t limit);

}  // namespace semfield
