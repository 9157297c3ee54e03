function __rig_complete
    set -l program (string replace -r '^~' $HOME -- (commandline -opc)[1])
    for line in ($program __complete fish (commandline -cp | string collect) 2>/dev/null)
        if test $line = \t/
            __fish_complete_directories (commandline -ct)
        else if string match -q \t'*' -- $line
            __fish_complete_suffix (string split -n ' ' -- (string trim -- $line))
        else
            echo $line
        end
    end
end
complete -c rig -f -a '(__rig_complete)'
