# Installs the build tree into an empty prefix, builds this project against it and runs it, then moves the prefix and uses the program there. Called by CTest with BUILD_DIR, WORK_DIR,
# SOURCE_DIR, GENERATOR, COMPILER and FLAGS.
function(step what)
  execute_process(COMMAND ${ARGN} RESULT_VARIABLE code OUTPUT_VARIABLE output ERROR_VARIABLE output)
  if(NOT code EQUAL 0)
    message(FATAL_ERROR "${what} failed (${code}):\n${output}")
  endif()
  set(last_output "${output}" PARENT_SCOPE)
endfunction()

file(REMOVE_RECURSE ${WORK_DIR})
step("install" ${CMAKE_COMMAND} --install ${BUILD_DIR} --prefix ${WORK_DIR}/prefix)
step("configure" ${CMAKE_COMMAND} -S ${SOURCE_DIR} -B ${WORK_DIR}/build -G ${GENERATOR} -DCMAKE_CXX_COMPILER=${COMPILER}
     -DCMAKE_CXX_COMPILER_LAUNCHER=${LAUNCHER} "-DCMAKE_CXX_FLAGS=${FLAGS}" -DCMAKE_PREFIX_PATH=${WORK_DIR}/prefix)
step("build" ${CMAKE_COMMAND} --build ${WORK_DIR}/build)
step("drive" ${WORK_DIR}/build/drive ${WORK_DIR}/build)
message(STATUS "${last_output}")

# The kernels of a plugin outside: without a word the best that CPU and package have, and with SEMFIELD_ISA each of them.
step("levels" ${WORK_DIR}/build/levels ${WORK_DIR}/build)
message(STATUS "${last_output}")
if(NOT last_output MATCHES "ripples: isa_([a-z0-9]+) of ([a-z0-9_ ]+)")
  message(FATAL_ERROR "levels does not say which kernels ran:\n${last_output}")
endif()
set(best ${CMAKE_MATCH_1})
string(REPLACE " " ";" levels "${CMAKE_MATCH_2}")
list(REMOVE_ITEM levels avx512_bf16 amx_emulated amx_bf16)  # these have products of their own alone: a plugin's kernels are those of avx512
set(reached FALSE)
foreach(level ${levels})
  execute_process(COMMAND ${CMAKE_COMMAND} -E env SEMFIELD_ISA=${level} ${WORK_DIR}/build/levels ${WORK_DIR}/build RESULT_VARIABLE code OUTPUT_VARIABLE output ERROR_VARIABLE errors)
  if(reached)  # more than this CPU has
    if(NOT code EQUAL 78)
      message(FATAL_ERROR "SEMFIELD_ISA=${level} should be refused (${code}):\n${output}${errors}")
    endif()
  elseif(NOT code EQUAL 0 OR NOT output MATCHES "ripples: isa_${level} ")
    message(FATAL_ERROR "SEMFIELD_ISA=${level} (${code}):\n${output}${errors}")
  endif()
  message(STATUS "SEMFIELD_ISA=${level}: ${output}${errors}")
  if(level STREQUAL best)
    set(reached TRUE)
  endif()
endforeach()
if(NOT reached)
  message(FATAL_ERROR "the best kernels, ${best}, are none of ${levels}")
endif()

# The installed program checks modules against the laws, and trains with them.
set(semfield ${WORK_DIR}/prefix/bin/semfield)
set(ENV{SEMFIELD_CACHE} ${WORK_DIR}/cache)
foreach(module ripples corridor)
  step("plugins check ${module}" ${semfield} plugins check ${WORK_DIR}/build/${module}.so)
  if(NOT last_output MATCHES "plugins check: passed=[2-9] failed=0 ")
    message(FATAL_ERROR "${module} is sound, and its check says:\n${last_output}")
  endif()
endforeach()
set(ENV{SEMFIELD_CACHE} off)

# The prefix moved elsewhere: from an empty folder the program finds its configurations, their parts and the shipped room.
set(moved "${WORK_DIR}/moved away")
file(RENAME ${WORK_DIR}/prefix "${moved}")
file(MAKE_DIRECTORY ${WORK_DIR}/empty)
set(semfield "${moved}/bin/semfield")
set(small --steps 20 --set scene.frames=8 --set scene.test_frames=2)
step("train quickstart" ${CMAKE_COMMAND} -E chdir ${WORK_DIR}/empty ${semfield} train quickstart ${small})
if(NOT last_output MATCHES "train: miou_present=0\\.[0-9]+ .* steps=20 ")
  message(FATAL_ERROR "train says no result:\n${last_output}")
endif()
file(WRITE ${WORK_DIR}/empty/own.yaml "include: presets/room.yaml\nscene: {type: obj_room, root: ${moved}/share/semfield/scenes/room}\n")
step("config check" ${CMAKE_COMMAND} -E chdir ${WORK_DIR}/empty ${semfield} config check own.yaml)
# The Python module of the prefix, in the program and in a process that knows nothing but where it lies.
if(EXISTS "${moved}/lib/python3/dist-packages/semfield")
  file(WRITE ${WORK_DIR}/empty/idea.py "import semfield as sf\n\n@sf.encoder('plain')\nclass Plain(sf.Encoder):\n    'Nothing else.'\n")
  step("a plugin of Python" ${CMAKE_COMMAND} -E chdir ${WORK_DIR}/empty ${semfield} plugins show plain --plugin idea.py)
  step("import semfield" ${CMAKE_COMMAND} -E env "PYTHONPATH=${moved}/lib/python3/dist-packages" PYTHONDONTWRITEBYTECODE=1 ${CMAKE_COMMAND} -E chdir ${WORK_DIR}/empty
       ${PYTHON} -c "import semfield; semfield.command('config', 'check', 'quickstart'); print(semfield.resolved('quickstart')['name'], semfield.__file__)")
  message(STATUS "${last_output}")
endif()
# Libraries as deep as Debian has them.
file(RENAME "${moved}/lib" ${WORK_DIR}/libraries)
file(MAKE_DIRECTORY "${moved}/lib")
file(RENAME ${WORK_DIR}/libraries "${moved}/lib/x86_64-linux-gnu")
step("config check, deeper" ${CMAKE_COMMAND} -E env "LD_LIBRARY_PATH=${moved}/lib/x86_64-linux-gnu/semfield"
     ${CMAKE_COMMAND} -E chdir ${WORK_DIR}/empty ${semfield} config check quickstart)
